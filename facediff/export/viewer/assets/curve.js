// The mouth's opening over time, one line for each animation that knows it.

const TOP = 10, BOTTOM = 22; // above the highest line, and below the lowest, where the seconds stand

/** Round numbers from 0 to an end, about as many as wanted. */
function ticks(end, wanted) {
  const rough = end / Math.max(1, wanted);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((value) => value >= rough * 0.999);
  const count = Math.floor(end / step + 1e-6);
  return Array.from({ length: count + 1 }, (_, i) => ({ value: i * step, text: +(i * step).toPrecision(6) + "" }));
}

class Curve extends Plot {
  /** Lines are {values, number}: openings in mm by frame, and the number of the animation. */
  constructor(canvas, cursor, lines, facts, onSeek, view) {
    super(canvas, cursor, facts, onSeek, view);
    this.lines = lines;
    this.highest = 1.08 * lines.reduce((most, line) => line.values.reduce((a, b) => Math.max(a, b), most), 0.5);
  }

  draw() {
    const pen = this.pen();
    const { wide, high, colour } = pen;
    const bottom = high - BOTTOM;
    const y = (value) => bottom - (value / this.highest) * (bottom - TOP);
    pen.fillStyle = colour("--quiet");
    pen.strokeStyle = colour("--line");
    pen.lineWidth = 1;
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (const { value, text } of ticks(this.highest, (bottom - TOP) / 28)) {
      const level = Math.round(y(value)) + 0.5;
      pen.beginPath();
      pen.moveTo(MARGIN.left, level);
      pen.lineTo(wide - MARGIN.right, level);
      pen.stroke();
      pen.fillText(text, MARGIN.left - 8, level);
    }
    pen.textBaseline = "alphabetic";
    pen.textAlign = "center";
    for (const { value, text } of ticks(this.view.to, (this.width / 90) * (this.view.to / this.view.span))) {
      if (value < this.view.from - 1e-9) continue;
      pen.fillText(`${text} s`, Math.min(this.x(value), wide - MARGIN.right - 8), high - 6);
    }
    pen.save();
    this.clip(pen);
    pen.lineWidth = 1.75;
    pen.lineJoin = "round";
    for (const line of this.lines) {
      pen.strokeStyle = colour(`--line-${line.number + 1}`);
      pen.beginPath();
      line.values.forEach((value, frame) => pen.lineTo(this.x(frame / this.facts.frameRate), y(value)));
      if (line.values.length === 1) pen.lineTo(this.x(this.seconds), y(line.values[0]));
      pen.stroke();
    }
    pen.restore();
    this.point(this.shown ?? 0);
  }
}
