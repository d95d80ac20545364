// How far the mouth may be open in each frame: the energy gate of facediff.speech.voice_activity, with its results.

const GATE_HOP = 160; // samples of a step of 10 ms
const QUIETEST_LEVEL = -65, SILENT_LEVEL = -120, LOUDEST_ABOVE = 40, FADING = 3;
const SMOOTH_STEPS = 5, LONG_STEPS = 100, CLEARLY = 10, NOISE_MEMORY = 500, HYSTERESIS = 3;
const NEAR_STEPS = 14, NEARLY_AS_LOUD = 9, BACKGROUND = 34;
/** Steps, decibels and which list: noise far below the speech, and noise as loud as it. */
const STEADY = [[25, 7, 0], [60, 3, 1], [LONG_STEPS, 5, 1]];
/** 150 Hz to 5 kHz at 16 kHz, in second-order sections: b0, b1, b2, a1, a2. */
const SPEECH_BAND = [
  [0.3979518861810659, 0.7959037723621318, 0.3979518861810659, 0.44530146335179394, 0.21624043303098522],
  [1.0, -2.0, 1.0, -1.9167376370775666, 0.9201986372050089],
];

/** Second-order sections one after the other. */
class RecursiveFilter {
  constructor(sections) {
    this.sections = sections.map((row) => ({ row, first: 0, second: 0 }));
  }

  feed(sample) {
    let value = sample;
    for (const section of this.sections) {
      const [b0, b1, b2, a1, a2] = section.row;
      const made = b0 * value + section.first;
      section.first = b1 * value - a1 * made + section.second;
      section.second = b2 * value - a2 * made;
      value = made;
    }
    return value;
  }
}

const decibels = (power) => (power > 1e-12 ? 10 * Math.log10(power) : SILENT_LEVEL);

/** Says for every 10 ms whether there is speech: what rises above the noise, whose level is followed. */
class EnergyListener {
  constructor(gate) {
    this.gate = gate;
    this.band = new RecursiveFilter(SPEECH_BAND);
    this.recent = []; // powers of the latest steps
    this.levels = []; // smoothed levels of the latest steps
    this.waiting = []; // levels that are not decided yet
    this.past = []; // levels of the latest steps that were decided on
    // Stretches [last step, level], softer ones later: short steady ones, long steady ones, and single steps.
    this.stretches = [[], [], []];
    this.loudest = QUIETEST_LEVEL;
    this.step = -1;
    this.speaking = false;
  }

  /** What is certain after one more step of samples: a list of at most one decision. */
  hear(samples) {
    let power = 0;
    for (const sample of samples) power += this.band.feed(sample) ** 2;
    this.follow(power / samples.length);
    return this.waiting.length > this.gate.ahead ? [this.decide()] : [];
  }

  finish() {
    return this.waiting.slice().map(() => this.decide());
  }

  follow(power) {
    this.step += 1;
    this.recent = [...this.recent.slice(1 - SMOOTH_STEPS), power];
    const level = decibels(this.recent.reduce((sum, each) => sum + each, 0) / this.recent.length);
    this.waiting.push(Math.max(level, decibels(power))); // a step that is loud by itself is loud
    this.levels = [...this.levels.slice(1 - LONG_STEPS), level];
    this.loudest = Math.max(level, this.loudest - FADING / 100, QUIETEST_LEVEL);
    this.keep(2, level);
    for (const [length, flat, which] of STEADY) {
      const some = this.levels.slice(-length).map((each) => Math.max(each, QUIETEST_LEVEL - 20));
      if (some.length === length && Math.max(...some) - Math.min(...some) < flat) {
        this.keep(which, some.reduce((sum, each) => sum + each, 0) / length);
      }
    }
    for (const stretches of this.stretches) {
      while (stretches.length && stretches[0][0] < this.step - NOISE_MEMORY) stretches.shift();
    }
  }

  /** Add the latest stretch to those that may become the softest one. */
  keep(which, value) {
    const stretches = this.stretches[which];
    while (stretches.length && stretches.at(-1)[1] >= value) stretches.pop();
    stretches.push([this.step, value]);
  }

  decide() {
    const level = this.waiting.shift(), [short, long] = this.stretches;
    this.past = [...this.past.slice(-NEAR_STEPS), level];
    let limit = Math.max(QUIETEST_LEVEL, this.loudest - LOUDEST_ABOVE);
    const noise = long.length ? [long[0][1]] : [];
    if (short.length && short[0][1] < this.loudest - CLEARLY) noise.push(short[0][1]);
    if (noise.length) limit = Math.max(limit, Math.min(...noise) + this.gate.margin);
    this.speaking = level > (this.speaking ? limit - HYSTERESIS : limit);
    return this.speaking && !this.behindSpeech();
  }

  /** Whether something sounds all the time, and nothing around the step is nearly as loud as the speech was. */
  behindSpeech() {
    if (this.gate.ahead < NEAR_STEPS || this.stretches[2][0][1] < this.loudest - BACKGROUND) return false;
    return Math.max(...this.past, ...this.waiting.slice(0, NEAR_STEPS)) < this.loudest - NEARLY_AS_LOUD;
  }
}

/**
 * From 0 (at rest) to 1 (as the model moves it) for every frame; speech may arrive in pieces.
 *
 * Args: a gate { margin, attack, lead, hold, release, ahead }, the last in steps of 10 ms; frames a second.
 */
class Openness {
  constructor(gate, frameRate) {
    this.gate = gate;
    this.frameRate = frameRate;
    this.listener = new EnergyListener(gate);
    this.rest = new Float32Array(0); // samples that fill no step yet
    this.active = [];
    this.first = 0; // the step of the first of these
    this.frames = 0; // that were given
    this.ahead = Math.ceil((gate.attack + gate.lead) * 100);
    this.behind = Math.ceil((gate.hold + gate.release) * 100);
  }

  /** The openness of the frames that are certain after more speech. */
  feed(samples) {
    const speech = joined(this.rest, samples);
    const whole = Math.floor(speech.length / GATE_HOP);
    this.rest = speech.slice(whole * GATE_HOP);
    for (let step = 0; step < whole; step++) {
      this.active.push(...this.listener.hear(speech.subarray(step * GATE_HOP, (step + 1) * GATE_HOP)));
    }
    const last = this.first + this.active.length - this.ahead - 1;
    return this.upTo(Math.max(this.frames, Math.floor((last / 100) * this.frameRate)));
  }

  /** The openness of the frames that are left. Args: frames in all. */
  finish(frames) {
    this.active.push(...this.listener.finish());
    return this.upTo(Math.max(frames, this.frames));
  }

  upTo(frames) {
    const found = [];
    for (let frame = this.frames; frame < frames; frame++) found.push(this.of(frame));
    this.frames = frames;
    const needed = Math.floor(((frames + 0.5) / this.frameRate) * 100) - this.behind - 2;
    const drop = Math.min(Math.max(0, needed - this.first), this.active.length);
    this.active = this.active.slice(drop);
    this.first += drop;
    return found;
  }

  of(frame) {
    const middle = ((frame + 0.5) / this.frameRate) * 100; // in steps
    const low = Math.max(0, Math.floor(middle) - this.behind - 1 - this.first);
    const high = Math.max(0, Math.ceil(middle) + this.ahead + 1 - this.first);
    const { attack, lead, hold, release } = this.gate;
    let found = 0;
    for (let place = low; place < Math.min(high, this.active.length); place++) {
      if (!this.active[place]) continue;
      const away = (place + this.first + 0.5 - middle) / 100; // seconds until that step; negative after it
      const [free, ramp] = away > 0 ? [lead, attack] : [hold, release];
      const beyond = Math.abs(away) - free;
      const share = beyond <= 0 ? 0 : ramp > 0 ? Math.min(1, beyond / ramp) : 1;
      found = Math.max(found, 1 - share * share * (3 - 2 * share));
    }
    return found;
  }
}

/** Bring offsets (frames · 3 V) as far to rest as the openness of their frames says. Args: also the weights (V). */
function towardRest(offsets, openness, weights) {
  const size = 3 * weights.length;
  openness.forEach((open, frame) => {
    if (open >= 1) return;
    for (let i = 0, at = frame * size; i < size; i++, at++) offsets[at] *= 1 - (1 - open) * weights[Math.floor(i / 3)];
  });
}
