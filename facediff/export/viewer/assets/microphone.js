// A microphone on the talking page: what it hears goes to the worker, and what comes back is shown in time.

/** Seconds of the microphone that may wait to be computed; what comes on top is not animated. */
const MOST_WAITING = 3;
/** Bursts of frames whose lateness decides how far the picture stays behind the microphone. */
const BURSTS = 30;
/** Seconds by which even the quickest of these bursts may be later than its windows say; else longer windows are tried. */
const MOST_LATE = 0.4;
/** Milliseconds after which the page says again how far behind the face is. */
const SAID_EVERY = 1000;

/** A microphone that is animated: it hears, sends what it hears to the worker, and shows what comes back, in time. */
class Listening {
  constructor(page, id, windows) {
    Object.assign(this, { page, id, windows });
    this.sent = this.done = this.lost = 0; // samples at 16 kHz
    this.origin = null; // when the first sample was heard, in ms
    this.queue = []; // frames { number, offsets } that wait for their moment
    this.late = []; // seconds by which the latest bursts came after their sound
    this.dropped = 0; // frames that came after their moment
    this.shown = -1;
    this.saidAt = -Infinity;
  }

  async open() {
    if (!navigator.mediaDevices) throw new Error("the microphone: a browser gives it to pages of this machine or of https only; open this page so");
    this.stream = await navigator.mediaDevices.getUserMedia({
      audio: { channelCount: 1, echoCancellation: false, noiseSuppression: false, autoGainControl: false },
    });
    this.context = new AudioContext();
    await this.context.audioWorklet.addModule("capture.js");
    const node = new AudioWorkletNode(this.context, "capture", { numberOfOutputs: 0 });
    this.resampler = new Resampler(this.context.sampleRate, SAMPLE_RATE);
    node.port.onmessage = ({ data }) => this.hear(data);
    this.context.createMediaStreamSource(this.stream).connect(node);
    for (const track of this.stream.getTracks()) {
      track.addEventListener("ended", () => this.page.listening === this && this.page.stopListening("the microphone was taken away"));
    }
    await this.context.resume();
  }

  hear(block) {
    const now = performance.now();
    this.origin ??= now - (1000 * block.length) / this.context.sampleRate;
    const samples = this.context.sampleRate === SAMPLE_RATE ? block : this.resampler.feed(block);
    if (this.sent - this.done > MOST_WAITING * SAMPLE_RATE) { // a slow machine would fall behind for ever
      this.lost += samples.length;
      this.page.say("this machine is too slow for the model: some speech is left out");
      return;
    }
    this.sent += samples.length;
    this.page.send({ kind: "feed", id: this.id, samples }, [samples.buffer]);
  }

  /** Seconds after the beginning at which a frame's sound was heard. */
  heardAt(number) {
    return number / this.page.about.frame_rate + this.lost / SAMPLE_RATE;
  }

  take(start, count, offsets) {
    const size = offsets.length / count, elapsed = (performance.now() - this.origin) / 1000;
    for (let i = 0; i < count; i++) this.queue.push({ number: start + i, offsets: offsets.subarray(i * size, (i + 1) * size) });
    this.late = [...this.late.slice(1 - BURSTS), elapsed - this.heardAt(start)];
    const { seconds: hop, after } = this.windows;
    if (this.late.length === BURSTS && Math.min(...this.late) > hop + after + MOST_LATE) this.page.wait();
  }

  /** How many seconds the picture stays behind the sound: as long as the slowest of the latest bursts took. */
  get lag() {
    return this.late.length ? Math.max(...this.late) + 0.02 : 0;
  }

  /** Show the frame whose moment has come; frames before it are dropped. */
  tick(now) {
    if (!this.queue.length) return;
    const elapsed = (now - this.origin) / 1000 - this.lag;
    let due = null;
    while (this.queue.length && this.heardAt(this.queue[0].number) <= elapsed) {
      if (due) this.dropped += 1;
      due = this.queue.shift();
    }
    if (!due) return;
    this.shown = due.number;
    this.page.show(due.offsets, due.number / this.page.about.frame_rate);
    if (now - this.saidAt < SAID_EVERY) return;
    this.saidAt = now;
    this.page.say(`listening: the face is ${this.lag.toFixed(1)} s behind` + (this.dropped ? `, ${this.dropped} frames left out` : ""));
  }

  close() {
    for (const track of this.stream?.getTracks() ?? []) track.stop();
    if (this.context && this.context.state !== "closed") this.context.close();
  }
}
