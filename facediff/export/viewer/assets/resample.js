// Sound at one rate as sound at another, in pieces: for microphones, whose rate the machine chooses.

// Next to the filter of soxr, by which facediff resamples: they differ by less than a thousandth of the loudest sample.
const SINC_ZEROS = 48; // zero crossings of the kernel on each side
const SINC_KAISER = 9; // shape of its window; side lobes 90 dB down
const SINC_CUT = 0.96; // where the band that passes ends, in halves of the lower rate
const MOST_PHASES = 2000;

/** The modified Bessel function of order 0. */
function bessel(x) {
  let sum = 1, term = 1;
  for (let k = 1; term > 1e-12 * sum; k++) sum += term *= (x / 2 / k) ** 2;
  return sum;
}

class Resampler {
  /** Args: samples a second that come, and that go; whole numbers. */
  constructor(from, to) {
    const divisor = (a, b) => (b ? divisor(b, a % b) : a), common = divisor(from, to);
    this.up = to / common; // phases of the kernel
    this.down = from / common;
    if (this.up > MOST_PHASES) throw new Error(`the microphone gives ${from} samples a second; choose 16000, 44100 or 48000`);
    const cut = SINC_CUT * Math.min(1, to / from);
    this.half = Math.ceil(SINC_ZEROS / cut);
    this.kernels = Array.from({ length: this.up }, (_, phase) => {
      const row = new Float32Array(2 * this.half);
      let sum = 0;
      for (let tap = 0; tap < row.length; tap++) {
        const away = tap - this.half + 1 - phase / this.up; // samples from the place that is wanted
        const inside = 1 - (away / this.half) ** 2;
        const angle = Math.PI * cut * away;
        if (inside > 0) sum += row[tap] = (angle ? Math.sin(angle) / angle : 1) * bessel(SINC_KAISER * Math.sqrt(inside));
      }
      return row.map((value) => value / sum); // each phase passes a constant as it is
    });
    this.held = new Float32Array(this.half - 1); // the sound before the first sample is silent
    this.at = 0; // place of the next sample to be made, in `up`-ths of a coming one, after the held ones
  }

  /** The samples that are certain after more. */
  feed(samples) {
    const all = joined(this.held, samples), made = [];
    // The kernel of place p reaches from p − half + 1 to p + half.
    for (; ; this.at += this.down) {
      const place = Math.floor(this.at / this.up), row = this.kernels[this.at % this.up];
      if (place + 2 * this.half > all.length) break;
      let sum = 0;
      for (let tap = 0; tap < row.length; tap++) sum += row[tap] * all[place + tap];
      made.push(sum);
    }
    const used = Math.min(Math.floor(this.at / this.up), all.length);
    this.held = all.slice(used);
    this.at -= used * this.up;
    return Float32Array.from(made);
  }
}

/** A whole recording at another rate. */
function resampled(samples, from, to) {
  if (from === to) return samples;
  const resampler = new Resampler(from, to), tail = new Float32Array(resampler.half + 1);
  return joined(resampler.feed(samples), resampler.feed(tail)).slice(0, Math.round((samples.length * to) / from));
}
