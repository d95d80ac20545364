// What the plots under the faces share: one time axis, a canvas that follows its place, and a cursor at the shown frame.

const MARGIN = { left: 46, right: 14 };

class Plot {
  /** Args: the canvas, the element of the cursor, the page's facts, and what goes to a frame. */
  constructor(canvas, cursor, facts, onSeek) {
    Object.assign(this, { canvas, cursor, facts, onSeek });
    this.seconds = facts.frames / facts.frameRate;
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  /** A press or a drag goes to a moment; plots that can be edited listen to more. */
  listen() {
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      this.onSeek(this.frameAt(event));
    });
    this.canvas.addEventListener("pointermove", (event) => event.buttons & 1 && this.onSeek(this.frameAt(event)));
  }

  get width() {
    return Math.max(1, this.canvas.clientWidth - MARGIN.left - MARGIN.right);
  }

  x(time) {
    return MARGIN.left + (time / this.seconds) * this.width;
  }

  /** Time under a pointer in s; outside of the plot, that of its nearer end. */
  timeAt(event) {
    const share = (event.clientX - this.canvas.getBoundingClientRect().left - MARGIN.left) / this.width;
    return Math.max(0, Math.min(1, share)) * this.seconds;
  }

  frameAt(event) {
    return Math.min(this.facts.frames - 1, Math.floor(this.timeAt(event) * this.facts.frameRate));
  }

  /** A pen on the emptied canvas, in pixels of the page; `pen.colour(name)` is a colour of the style sheet. */
  pen() {
    const { clientWidth: wide, clientHeight: high } = this.canvas;
    const scale = devicePixelRatio || 1;
    const width = Math.round(wide * scale), height = Math.round(high * scale);
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    // Drawn by the processor: without a graphics card, a drag would otherwise pile up work for seconds.
    const pen = this.canvas.getContext("2d", { willReadFrequently: true });
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, wide, high);
    const style = getComputedStyle(this.canvas);
    pen.font = `11px ${style.fontFamily}`;
    return Object.assign(pen, { wide, high, colour: (name) => style.getPropertyValue(name).trim() });
  }

  /** Move the cursor to a frame: it stands at the time from which the frame is shown, where keys and values of it are. */
  point(frame) {
    this.shown = frame;
    this.cursor.style.transform = `translateX(${this.x(frame / this.facts.frameRate)}px)`;
  }
}
