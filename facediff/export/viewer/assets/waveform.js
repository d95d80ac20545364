// The speech under the timeline: for each pixel the lowest and the highest sample in its time.

/** Samples (S, −1 to 1), all channels averaged, and their rate, of a WAV file of 16 bits. Throws if it is anything else. */
function readWav(buffer) {
  const view = new DataView(buffer);
  const name = (at) => String.fromCharCode(...new Uint8Array(buffer, at, 4));
  let rate = 0, channels = 0;
  for (let at = 12; at + 8 <= buffer.byteLength; at += 8 + 2 * Math.ceil(view.getUint32(at + 4, true) / 2)) {
    if (name(at) === "fmt ") {
      rate = view.getUint32(at + 12, true);
      // Format 1 is plain numbers; 65534 says the same in a longer form.
      if ([1, 65534].includes(view.getUint16(at + 8, true)) && view.getUint16(at + 22, true) === 16) channels = view.getUint16(at + 10, true);
    }
    if (name(at) !== "data" || !channels || !rate) continue;
    const bytes = Math.min(view.getUint32(at + 4, true), buffer.byteLength - at - 8);
    const numbers = new Int16Array(buffer.slice(at + 8, at + 8 + (bytes & ~1)));
    const samples = new Float32Array(Math.floor(numbers.length / channels));
    for (let i = 0; i < samples.length * channels; i++) samples[Math.floor(i / channels)] += numbers[i] / 32768 / channels;
    return { rate, samples };
  }
  throw new Error("the page's sound holds no samples of 16 bits; write the page again");
}

class Waveform extends Plot {
  constructor(canvas, cursor, facts, wav, onSeek, view) {
    super(canvas, cursor, facts, onSeek, view);
    this.hear(facts, wav);
  }

  /** Show a recording { samples, rate } from now on. */
  hear(facts, wav) {
    if (facts !== this.facts) this.view = new TimeView(facts.frames / facts.frameRate);
    this.facts = facts;
    this.seconds = facts.frames / facts.frameRate;
    this.wav = wav;
    this.loudest = wav.samples.reduce((most, value) => Math.max(most, Math.abs(value)), 1e-3);
  }

  draw() {
    const pen = this.pen();
    const { samples, rate } = this.wav;
    const middle = pen.high / 2, reach = middle - 2;
    pen.fillStyle = pen.colour("--line");
    pen.fillRect(MARGIN.left, middle - 0.5, this.width, 1);
    pen.fillStyle = pen.colour("--quiet");
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    pen.fillText("voice", MARGIN.left - 8, middle);
    pen.fillStyle = pen.colour("--wave");
    for (let pixel = 0; pixel < this.width; pixel++) {
      const sample = (x) => Math.floor((this.view.from + (x / this.width) * this.view.span) * rate);
      const start = sample(pixel);
      const end = Math.min(samples.length, Math.max(start + 1, sample(pixel + 1)));
      let low = 0, high = 0;
      for (let i = start; i < end; i++) {
        if (samples[i] < low) low = samples[i];
        else if (samples[i] > high) high = samples[i];
      }
      const top = middle - (high / this.loudest) * reach, bottom = middle - (low / this.loudest) * reach;
      pen.fillRect(MARGIN.left + pixel, top, 1, Math.max(1, bottom - top));
    }
    this.point(this.shown ?? 0);
  }
}

/** Words and phonemes under the waveform: those whose text has room. */
class Sounds extends Plot {
  constructor(canvas, cursor, facts, onSeek, view) {
    super(canvas, cursor, facts, onSeek, view);
    this.words = [];
    for (const [start, end, , word] of facts.sounds) {
      const last = this.words.at(-1);
      if (!word) continue;
      // Phonemes of a word follow each other; the same word twice begins again after a pause.
      if (last && last[2] === word && Math.abs(start - last[1]) < 0.02) last[1] = end;
      else this.words.push([start, end, word]);
    }
    canvas.setAttribute("aria-label", this.words.map(([, , word]) => word).join(" ") || "Phonemes of the speech");
  }

  draw() {
    const pen = this.pen(), { view } = this;
    const { high, colour } = pen, sounds = this.facts.sounds.map(([start, end, ipa]) => [start, end, ipa]);
    const rows = this.words.length ? [this.words, sounds] : [sounds];
    pen.textBaseline = "middle";
    pen.save();
    this.clip(pen);
    rows.forEach((row, number) => {
      const middle = ((number + 0.5) / rows.length) * high;
      for (const [start, end, text] of row) {
        if (!text || end < view.from || start > view.to) continue;
        const left = this.x(start), right = this.x(end);
        pen.fillStyle = colour("--line");
        pen.fillRect(left, middle - high / rows.length / 2 + 1, 1, high / rows.length - 2);
        pen.fillStyle = colour(number || rows.length === 1 ? "--quiet" : "--ink");
        pen.textAlign = "center";
        if (pen.measureText(text).width < right - left - 1) pen.fillText(text, (left + right) / 2, middle);
      }
    });
    pen.restore();
    this.point(this.shown ?? 0);
  }
}
