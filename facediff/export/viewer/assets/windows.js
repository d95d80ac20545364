// Long speech and streams by windows that blend into each other: the rules of facediff.speech.windows, with its results.

const SAMPLE_RATE = 16_000;
/** Deviation below which speech is not amplified further: noise of a microphone, not speech. */
const QUIETEST_DEVIATION = 0.003;

/** The nearest whole number, of two equally near ones the even one, as Python rounds. */
function nearest(value) {
  const low = Math.floor(value), rest = value - low;
  return rest < 0.5 || (rest === 0.5 && low % 2 === 0) ? low : low + 1;
}

const samplesFor = (frames, frameRate) => nearest((frames * SAMPLE_RATE) / frameRate);

/** A plan { seconds, overlap, before, after, past, ahead } in frames. */
function inFrames(plan, frameRate) {
  const frames = nearest(plan.seconds * frameRate), past = nearest((plan.past ?? 0) * frameRate);
  if (frames < (past ? 1 : 4)) throw new Error(`windows of ${plan.seconds} s are too few frames at ${frameRate} a second; choose longer ones`);
  const wanted = nearest(plan.overlap * frameRate);
  const overlap = past ? Math.min(wanted, frames - 1) : Math.max(1, Math.min(wanted, Math.floor(frames / 2)));
  const before = nearest(plan.before * frameRate), after = nearest(plan.after * frameRate);
  return { frames, overlap, before, after, past, ahead: nearest((plan.ahead ?? 0) * frameRate), hop: frames - overlap };
}

/** One window of long speech. Args: the plan; how many windows come before it; its new frames, fewer for the last one. */
class SpeechWindow {
  constructor(plan, index, fresh = plan.frames) {
    const at = index * plan.hop;
    this.plan = plan;
    this.index = index;
    this.fixed = Math.min(plan.past, at); // its first frames, which are given out already
    this.frames = this.fixed + fresh;
    this.start = at - this.fixed;
    this.end = this.start + this.frames;
    this.context = Math.min(plan.before, this.start); // frames before it that the model hears too
    this.shared = index ? this.fixed + plan.overlap : 0; // its first frames, which the window before it has as well
    this.kept = Math.min(plan.past, at + plan.hop) + plan.overlap; // its last frames, which the next window has as well
  }

  /** The windows in which its frames, and those ahead of it, first appear: [index, from, to], of the frames that are new in that window. */
  get origins() {
    const { overlap, hop, ahead } = this.plan, found = [], last = this.end + ahead;
    const latest = Math.max(this.index, Math.floor((last - 1 - overlap) / hop));
    for (let index = Math.max(0, Math.floor((this.start - overlap) / hop)); index <= latest; index++) {
      const first = index ? index * hop + overlap : 0;
      const begin = Math.max(this.start, first), end = Math.min(last, (index + 1) * hop + overlap);
      if (begin < end) found.push([index, begin - first, end - first]);
    }
    return found;
  }
}

/** Mean and deviation of all samples so far. */
class Level {
  constructor() {
    this.count = this.sum = this.squares = 0;
  }

  hear(samples) {
    this.count += samples.length;
    for (const value of samples) {
      this.sum += value;
      this.squares += value * value;
    }
  }

  get mean() {
    return this.sum / Math.max(this.count, 1);
  }

  get deviation() {
    return Math.sqrt(Math.max(0, this.squares / Math.max(this.count, 1) - this.mean ** 2));
  }
}

/** Samples one after the other. */
function joined(first, second) {
  const made = new Float32Array(first.length + second.length);
  made.set(first);
  made.set(second, first.length);
  return made;
}

/**
 * Animates speech that arrives in pieces, window by window; memory does not grow with its length.
 *
 * Args: the plan in frames; frames a second; `generate(window, speech, frames, mean, deviation)`, which gives a window's
 * motion but for its past as an array (frames · size); the size of a frame.
 */
class SpeechWindows {
  constructor(plan, frameRate, generate, size) {
    Object.assign(this, { plan, frameRate, generate, size });
    this.speech = new Float32Array(0);
    this.dropped = 0; // samples before these, which no window will hear again
    this.level = new Level();
    this.window = new SpeechWindow(plan, 0);
    this.held = null; // the latest window's frames that the next one shares
  }

  get heard() {
    return this.dropped + this.speech.length;
  }

  sample(frame) {
    return samplesFor(frame, this.frameRate);
  }

  /** Hear more speech; the parts of motion that have become certain. */
  async feed(samples) {
    this.speech = joined(this.speech, samples);
    const parts = [];
    while (this.heard >= this.sample(this.window.end + this.plan.after)) {
      parts.push(await this.nextWindow(this.window.end + this.plan.after));
    }
    return parts;
  }

  /** The motion that is left. Args: frames in all; as many as fit the speech if absent. */
  async finish(frames) {
    const total = frames ?? nearest((this.heard * this.frameRate) / SAMPLE_RATE);
    if (total < 1) throw new Error("the speech is shorter than one frame");
    const missing = this.sample(total) - this.heard;
    if (missing > 0) this.speech = joined(this.speech, new Float32Array(missing));
    const parts = [];
    while (this.window.end < total) parts.push(await this.nextWindow(Math.min(total, this.window.end + this.plan.after)));
    // What is left lies within the last window; if the window before has animated it already, it is certain now.
    const { fixed, index } = this.window, left = total - this.window.start - fixed;
    if (this.held && left <= this.plan.overlap) parts.push(this.held.subarray(0, left * this.size));
    else parts.push(await this.make(new SpeechWindow(this.plan, index, left), total));
    return parts;
  }

  /** The window's frames before its overlap with the next, given speech up to frame `heard`; then advance. */
  async nextWindow(heard) {
    const motion = await this.make(this.window, heard);
    this.window = new SpeechWindow(this.plan, this.window.index + 1);
    const needed = this.sample(this.window.start - this.window.context);
    const drop = Math.max(0, Math.min(needed, this.level.count) - this.dropped);
    this.speech = this.speech.slice(drop);
    this.dropped += drop;
    return motion.subarray(0, this.plan.hop * this.size);
  }

  async make(window, heard) {
    const start = window.start - window.context;
    const first = this.sample(start) - this.dropped, last = this.sample(heard) - this.dropped;
    this.level.hear(this.speech.subarray(Math.max(0, this.level.count - this.dropped), last));
    const deviation = Math.max(this.level.deviation, QUIETEST_DEVIATION);
    let speech = this.speech.slice(first, last);
    const seen = window.end + this.plan.ahead;
    if (seen > heard) speech = joined(speech, new Float32Array(this.sample(seen) - this.sample(heard)).fill(this.level.mean));
    const motion = await this.generate(window, speech, Math.max(heard, seen) - start, this.level.mean, deviation);
    this.held = motion.slice(motion.length - this.plan.overlap * this.size);
    return motion;
  }
}
