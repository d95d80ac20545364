// What the plots under the faces share: one time axis, a canvas that follows its place, and a cursor at the shown frame.

const MARGIN = { left: 46, right: 14 };
const SHORTEST_VIEW = 0.2; // s that fill a plot at the closest

/** The stretch of time that plots show. */
class TimeView {
  constructor(seconds, onChange = () => {}) {
    Object.assign(this, { seconds, onChange, from: 0, to: seconds });
  }

  get span() {
    return this.to - this.from;
  }

  get whole() {
    return this.span > this.seconds - 1e-9;
  }

  /** Show a stretch that begins at a time, within what there is. */
  set(from, span) {
    span = Math.max(Math.min(SHORTEST_VIEW, this.seconds), Math.min(this.seconds, span));
    from = Math.max(0, Math.min(this.seconds - span, from));
    if (from === this.from && Math.abs(span - this.span) < 1e-9) return;
    Object.assign(this, { from, to: from + span });
    this.onChange();
  }

  /** Magnify by a factor; a time stays where it is. */
  zoom(factor, about = (this.from + this.to) / 2) {
    const share = (about - this.from) / this.span;
    const span = Math.max(Math.min(SHORTEST_VIEW, this.seconds), Math.min(this.seconds, this.span / factor));
    this.set(about - share * span, span);
  }

  scroll(share) {
    this.set(this.from + share * this.span, this.span);
  }

  /** Turn the page when the shown time has left it. */
  follow(time) {
    if (time < this.from - 1e-9 || time > this.to + 1e-9) this.set(time - 0.05 * this.span, this.span);
  }
}

class Plot {
  /**
   * Args: the canvas, the element of the cursor, the page's facts, what goes to a frame, and the view that it shares with
   * other plots; without one it always shows the whole time.
   */
  constructor(canvas, cursor, facts, onSeek, view = null) {
    Object.assign(this, { canvas, cursor, facts, onSeek });
    this.seconds = facts.frames / facts.frameRate;
    this.view = view ?? new TimeView(this.seconds);
    if (view) this.listenToZoom();
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
    const dark = matchMedia("(prefers-color-scheme: dark)"), { signal } = this.gone;
    dark.addEventListener("change", () => this.draw(), { signal });
  }

  gone = new AbortController(); // aborted when the plot has left the page for good

  /** A press or a drag goes to a moment; plots that can be edited listen to more. */
  listen() {
    this.canvas.addEventListener("pointerdown", (event) => {
      this.canvas.setPointerCapture(event.pointerId);
      this.onSeek(this.frameAt(event));
    });
    this.canvas.addEventListener("pointermove", (event) => event.buttons & 1 && this.onSeek(this.frameAt(event)));
  }

  /** A wheel with Ctrl, or two fingers, magnify the time; with Shift, or sideways, the wheel scrolls it. */
  listenToZoom() {
    const { canvas } = this;
    canvas.addEventListener("wheel", (event) => {
      const closer = Math.exp(-event.deltaY / 250), sideways = event.deltaX || (event.shiftKey ? event.deltaY : 0);
      if (event.ctrlKey || event.metaKey) this.view.zoom(closer, this.timeAt(event));
      else if (event.altKey && this.zoomValue) this.zoomValue(closer, this.valueUnder(event));
      else if (Math.abs(sideways) >= Math.abs(event.deltaY)) this.view.scroll(sideways / this.width);
      else return; // the page's own scrolling
      event.preventDefault();
    }, { passive: false });
    const fingers = new Map();
    const pinch = (event) => {
      if (!fingers.has(event.pointerId)) return;
      const apart = () => {
        const [a, b] = fingers.values();
        return [Math.abs(a.clientX - b.clientX), Math.abs(a.clientY - b.clientY)];
      };
      const before = fingers.size === 2 ? apart() : null;
      fingers.set(event.pointerId, event);
      if (!before) return;
      event.stopImmediatePropagation();
      const now = apart(), [first, second] = fingers.values();
      const between = { clientX: (first.clientX + second.clientX) / 2, clientY: (first.clientY + second.clientY) / 2 };
      if (Math.min(before[0], now[0]) > 12) this.view.zoom(now[0] / before[0], this.timeAt(between));
      if (this.zoomValue && Math.min(before[1], now[1]) > 12) this.zoomValue(now[1] / before[1], this.valueUnder(between));
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.pointerType !== "touch") return;
      fingers.set(event.pointerId, event);
      if (fingers.size !== 2) return;
      event.stopImmediatePropagation();
      this.letGo?.();
    }, true);
    canvas.addEventListener("pointermove", pinch, true);
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => fingers.delete(event.pointerId), true);
  }

  get width() {
    return Math.max(1, this.canvas.clientWidth - MARGIN.left - MARGIN.right);
  }

  x(time) {
    return MARGIN.left + ((time - this.view.from) / this.view.span) * this.width;
  }

  /** Time under a pointer in s; outside of the plot, that of its nearer end. */
  timeAt(event) {
    const share = (event.clientX - this.canvas.getBoundingClientRect().left - MARGIN.left) / this.width;
    return this.view.from + Math.max(0, Math.min(1, share)) * this.view.span;
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

  /** Keep what is drawn next within the plot, with so many pixels more at its sides. */
  clip(pen, more = 0) {
    pen.beginPath();
    pen.rect(MARGIN.left - more, 0, this.width + 2 * more, pen.high);
    pen.clip();
  }

  /** Move the cursor to a frame: it stands at the time from which the frame is shown, where keys and values of it are. */
  point(frame) {
    this.shown = frame;
    const x = this.x(frame / this.facts.frameRate);
    this.cursor.hidden = x < MARGIN.left - 1 || x > MARGIN.left + this.width + 1;
    this.cursor.style.transform = `translateX(${x}px)`;
  }
}
