// The mouth's opening over time, one line for each animation that knows it, with a cursor at the shown frame.

const MARGIN = { left: 46, right: 14, top: 10, bottom: 22 };

/** Round numbers from 0 to an end, about as many as wanted. */
function ticks(end, wanted) {
  const rough = end / Math.max(1, wanted);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((value) => value >= rough * 0.999);
  const count = Math.floor(end / step + 1e-6);
  return Array.from({ length: count + 1 }, (_, i) => ({ value: i * step, text: +(i * step).toPrecision(6) + "" }));
}

class Curve {
  /** Lines are {values, number}: openings in mm by frame, and the number of the animation. */
  constructor(canvas, cursor, lines, facts, onSeek) {
    Object.assign(this, { canvas, cursor, lines, facts });
    this.seconds = facts.frames / facts.frameRate;
    this.highest = 1.08 * lines.reduce((most, line) => line.values.reduce((a, b) => Math.max(a, b), most), 0.5);
    const seek = (event) => {
      const box = canvas.getBoundingClientRect();
      const share = (event.clientX - box.left - MARGIN.left) / this.width;
      onSeek(Math.max(0, Math.min(facts.frames - 1, Math.floor(share * facts.frames))));
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      seek(event);
    });
    canvas.addEventListener("pointermove", (event) => event.buttons & 1 && seek(event));
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  get width() {
    return Math.max(1, this.canvas.clientWidth - MARGIN.left - MARGIN.right);
  }

  x(time) {
    return MARGIN.left + (time / this.seconds) * this.width;
  }

  draw() {
    const { clientWidth: wide, clientHeight: high } = this.canvas;
    const scale = devicePixelRatio || 1;
    Object.assign(this.canvas, { width: Math.round(wide * scale), height: Math.round(high * scale) });
    const pen = this.canvas.getContext("2d");
    pen.scale(scale, scale);
    const style = getComputedStyle(this.canvas);
    const colour = (name) => style.getPropertyValue(name).trim();
    const bottom = high - MARGIN.bottom;
    const y = (value) => bottom - (value / this.highest) * (bottom - MARGIN.top);
    pen.font = `11px ${style.fontFamily}`;
    pen.fillStyle = colour("--quiet");
    pen.strokeStyle = colour("--line");
    pen.lineWidth = 1;
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (const { value, text } of ticks(this.highest, (bottom - MARGIN.top) / 28)) {
      const level = Math.round(y(value)) + 0.5;
      pen.beginPath();
      pen.moveTo(MARGIN.left, level);
      pen.lineTo(wide - MARGIN.right, level);
      pen.stroke();
      pen.fillText(text, MARGIN.left - 8, level);
    }
    pen.textBaseline = "alphabetic";
    pen.textAlign = "center";
    for (const { value, text } of ticks(this.seconds, this.width / 90)) {
      pen.fillText(`${text} s`, Math.min(this.x(value), wide - MARGIN.right - 8), high - 6);
    }
    pen.lineWidth = 1.75;
    pen.lineJoin = "round";
    for (const line of this.lines) {
      pen.strokeStyle = colour(`--line-${line.number + 1}`);
      pen.beginPath();
      // A frame's value is drawn in the middle of the time in which the frame is shown.
      line.values.forEach((value, frame) => pen.lineTo(this.x((frame + 0.5) / this.facts.frameRate), y(value)));
      if (line.values.length === 1) pen.lineTo(this.x(this.seconds), y(line.values[0]));
      pen.stroke();
    }
    this.point(this.shown ?? 0);
  }

  /** Move the cursor to a frame. */
  point(frame) {
    this.shown = frame;
    this.cursor.style.transform = `translateX(${this.x((frame + 0.5) / this.facts.frameRate)}px)`;
  }
}
