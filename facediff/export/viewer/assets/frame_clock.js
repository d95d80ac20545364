// How many frames a model gives for speech: the rules of facediff.speech.frame_clock, in their orders of operations.

const CLOCK_RULES = ["rounded", "steps", "pairs", "seconds", "seconds_or_pairs", "rows", "up"];
const STEP_RATE = 50; // steps a second of pretrained speech networks
/** Kernels and strides of the convolutions of wav2vec 2.0 and HuBERT. */
const CONVOLUTIONS = [[10, 5], [3, 2], [3, 2], [3, 2], [3, 2], [2, 2], [2, 2]];

/** Steps that convolutions without padding make of so many samples. */
function convolved(samples, layers) {
  return layers.reduce((count, [kernel, stride]) => Math.max(0, Math.floor((count - kernel) / stride) + 1), samples);
}

class FrameClock {
  constructor(frameRate, { rule = "rounded", convolutions = CONVOLUTIONS, rows = 1 }) {
    Object.assign(this, { frameRate, rule, convolutions, rows });
  }

  /** Frames for so many samples at 16 kHz; 0 or less if they are too few for one. */
  frames(samples) {
    const { frameRate, rows } = this;
    const steps = () => convolved(samples, this.convolutions), pairs = () => Math.floor(steps() / 2);
    const whole = () => Math.trunc((samples / SAMPLE_RATE) * frameRate) - 1;
    switch (this.rule) {
      case "rounded": return nearest((samples * frameRate) / SAMPLE_RATE);
      case "steps": return Math.trunc((steps() / STEP_RATE) * frameRate);
      case "pairs": return pairs();
      case "seconds": return whole();
      case "seconds_or_pairs": return Math.min(whole(), pairs());
      case "up": return Math.ceil((samples / SAMPLE_RATE) * frameRate);
      default: return Math.ceil(nearest((samples / SAMPLE_RATE) * (frameRate * rows)) / rows);
    }
  }
}
