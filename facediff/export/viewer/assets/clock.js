// The clock that the picture follows: the sound's where there is sound, otherwise the machine's.

/** Rounding of media times must not show the frame before; a hundredth of a frame is too little to be seen. */
const FRAME_LEEWAY = 0.01;

/** A time in minutes and seconds, as pages write it. */
const seconds = (value) => `${Math.floor(value / 60)}:${(value % 60).toFixed(2).padStart(5, "0")}`;

/** The frame that is shown at a time: frame t from t / rate on. */
function frameAt(time, rate, frames) {
  return Math.max(0, Math.min(frames - 1, Math.floor(time * rate + FRAME_LEEWAY)));
}

/** Follows an audio element. Where a browser's time moves in jumps, it interpolates, by half a frame at most. */
class SoundClock {
  constructor(audio, rate) {
    this.audio = audio;
    this.leeway = 0.5 / rate;
    this.reported = -1;
    this.at = 0;
    this.last = 0;
  }

  get playing() {
    return !this.audio.paused && !this.audio.ended;
  }

  get time() {
    const reported = this.audio.currentTime;
    const now = performance.now() / 1000;
    if (reported !== this.reported || !this.playing || this.audio.seeking) {
      this.reported = reported;
      this.at = now;
    }
    const between = this.playing ? Math.min((now - this.at) * this.audio.playbackRate, this.leeway) : 0;
    const time = reported + between;
    // A guess that ran ahead waits for the sound; only a seek or a loop goes back.
    const back = this.last - time;
    this.last = this.playing && back > 0 && back <= this.leeway ? this.last : time;
    return this.last;
  }

  async play() {
    await this.audio.play();
  }

  pause() {
    this.audio.pause();
  }

  seek(time) {
    this.audio.currentTime = time;
  }

  set speed(value) {
    this.audio.playbackRate = value;
  }

  set loop(value) {
    this.audio.loop = value;
  }
}

/** The machine's clock, for animations without sound. */
class SilentClock {
  constructor(seconds) {
    this.seconds = seconds;
    this.playing = false;
    this.rate = 1;
    this.loop = false;
    this.base = 0; // time at `since`
    this.since = 0;
  }

  get time() {
    if (!this.playing) return this.base;
    const time = this.base + ((performance.now() - this.since) / 1000) * this.rate;
    if (time < this.seconds) return time;
    if (this.loop) { // time starts at 0 in every round, so that this round is played to its end when the loop is switched off
      this.seek(time % this.seconds);
      return this.base;
    }
    this.base = this.seconds;
    this.playing = false;
    return this.base;
  }

  async play() {
    this.seek(this.time >= this.seconds ? 0 : this.time);
    this.playing = true;
  }

  pause() {
    this.seek(this.time);
    this.playing = false;
  }

  seek(time) {
    this.base = time;
    this.since = performance.now();
  }

  set speed(value) {
    this.seek(this.time);
    this.rate = value;
  }
}
