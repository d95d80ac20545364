// The lanes under the timeline: one for each channel with keys, drawn and edited by pointer or keyboard.

const REACH = { mouse: 9, pen: 12, touch: 18 }; // pixels around a key that grasp it
const EDGE_SPACE = 9; // between the lane's border and the ends of its range, so that keys there are whole

/** Short numbers: 0.1 + 0.2 is 0.3. */
const short = (number) => String(Number(number.toFixed(3)));

class Lane extends Plot {
  /** Args: the editor, and the channel's name. Makes its own elements. */
  constructor(editor, name) {
    const canvas = make("canvas");
    const cursor = make("div", "cursor");
    super(canvas, cursor, editor.facts, (frame) => editor.player.seek(frame), editor.player.view);
    Object.assign(this, { editor, name, known: editor.direction.channel(name) });
    this.start();
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application"); // arrow keys are the lane's own
    canvas.setAttribute("aria-describedby", "lane-help");
    const head = make("div", "lane-head");
    this.now = make("span", "value");
    const button = (text, label, action) => {
      const made = make("button", "small", text);
      made.type = "button";
      made.title = label;
      made.setAttribute("aria-label", `${label}: ${name}`);
      made.addEventListener("click", action);
      return made;
    };
    head.append(make("b", "", name), this.now);
    if (this.known.unit) head.append(make("span", "what", this.known.unit));
    this.later = make("span", "mark", "shows after a new run");
    this.later.hidden = editor.canPreview(name);
    head.append(this.later);
    const tools = make("span", "lane-tools");
    if (this.known.range) {
      tools.append(
        button("−", "Show more values", () => this.zoomValue(1 / 1.5)),
        button("+", "Magnify the values", () => this.zoomValue(1.5)),
        button("Fit", "Fit the lane to its keys", () => this.fit())
      );
    }
    tools.append(
      button("+ Key", "Add a key here", () => this.add(editor.time)),
      button("✕", "Remove the channel", () => editor.removeLane(this))
    );
    head.append(tools);
    const plot = make("div", "plot lane-plot");
    plot.append(canvas, cursor);
    this.element = make("div", "lane");
    this.element.append(head, plot);
  }

  leave() {
    this.element.remove();
    this.gone.abort();
  }

  get keys() {
    return this.editor.direction.of(this.name);
  }

  get range() {
    return this.known.range ?? [0, 1];
  }

  /** Show the values that a channel usually takes, and those of its keys. */
  start() {
    const values = this.keys.map(({ value }) => value), [least, most] = this.known.usual ?? this.range;
    this.seen = this.known.range ? [Math.min(least, ...values), Math.max(most, ...values)] : this.range;
  }

  /** Show what the curve takes, with a margin. */
  fit() {
    const { keys, range } = this, slopes = slopesOf(keys);
    if (!keys.length) this.start();
    else {
      const from = keys[0].time, span = keys.at(-1).time - from;
      const values = Array.from({ length: 201 }, (_, i) => valueAt(keys, from + (span * i) / 200, range, 0, slopes));
      const least = Math.min(...values), most = Math.max(...values);
      this.see((least + most) / 2, Math.max(1.25 * (most - least), (range[1] - range[0]) / 20));
    }
    this.editor.drawLanes();
  }

  /** Magnify the values by a factor; one of them stays where it is. */
  zoomValue(factor, about = this.editor.selected?.channel === this.name ? this.editor.selected.value : (this.seen[0] + this.seen[1]) / 2) {
    if (!this.known.range) return;
    const [least, most] = this.seen, span = (most - least) / factor;
    this.see(about + ((least + most) / 2 - about) / factor, span);
    this.editor.drawLanes();
  }

  see(middle, span) {
    const [least, most] = this.range;
    span = Math.max((most - least) / 200, Math.min(most - least, span));
    const low = Math.max(least, Math.min(most - span, middle - span / 2));
    this.seen = [low, low + span];
  }

  y(value) {
    const [least, most] = this.seen;
    const share = typeof value === "number" ? (value - least) / (most - least) : 0.5;
    return EDGE_SPACE + (1 - share) * (this.canvas.clientHeight - 2 * EDGE_SPACE);
  }

  valueUnder(event) {
    const [least, most] = this.seen;
    const box = this.canvas.getBoundingClientRect();
    const share = 1 - (event.clientY - box.top - EDGE_SPACE) / (box.height - 2 * EDGE_SPACE);
    return Math.max(this.range[0], Math.min(this.range[1], least + share * (most - least)));
  }

  /** The key under a pointer. */
  keyUnder(event) {
    const box = this.canvas.getBoundingClientRect();
    const far = (key) => Math.hypot(this.x(key.time) - event.clientX + box.left, this.y(key.value) - event.clientY + box.top);
    const nearest = this.keys.reduce((best, key) => (!best || far(key) < far(best) ? key : best), null);
    return nearest && far(nearest) <= REACH[event.pointerType || "mouse"] ? nearest : null;
  }

  add(time, value) {
    this.editor.select(this.editor.direction.add(this.name, this.editor.snapped(time), value));
  }

  // Pointers: a press on a key selects and drags it and all that are chosen, elsewhere it goes to the moment, or with Shift
  // draws a box around keys; a double click adds a key there.

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => this.letGo());
    canvas.addEventListener("dblclick", (event) => this.keyUnder(event) || this.add(this.timeAt(event), this.known.range ? this.valueUnder(event) : undefined));
    canvas.addEventListener("keydown", (event) => this.type(event));
    canvas.addEventListener("focus", () => this.editor.enter(this));
  }

  press(event) {
    if (event.button) return;
    this.canvas.setPointerCapture(event.pointerId);
    const { editor } = this, key = this.keyUnder(event);
    if (!key && (event.shiftKey || editor.boxing)) {
      if (document.activeElement !== this.canvas) this.canvas.focus({ preventScroll: true });
      this.box = { x: event.clientX, y: event.clientY, kept: event.shiftKey ? editor.chosen : [] };
      return;
    }
    if (key && event.shiftKey) editor.toggle(key, this);
    else if (!key || !editor.chosen.includes(key)) editor.select(key, this);
    else editor.choose([...editor.chosen.filter((other) => other !== key), key], this);
    if (!key) return this.onSeek(this.frameAt(event));
    if (!editor.chosen.includes(key)) return;
    this.grasp = { key, keys: editor.chosen, x: event.clientX, y: event.clientY, moved: false };
    editor.direction.hold();
  }

  drag(event) {
    if (!(event.buttons & 1)) {
      this.canvas.style.cursor = this.keyUnder(event) ? "grab" : "";
      return;
    }
    if (this.box) return this.editor.drawBox(this.box, event, this);
    if (!this.grasp) return this.onSeek(this.frameAt(event));
    const { grasp } = this;
    if (!grasp.moved && Math.hypot(event.clientX - grasp.x, event.clientY - grasp.y) < 3) return; // a click, not a drag
    grasp.moved = true;
    if (grasp.keys.length > 1) {
      const time = event.shiftKey ? grasp.key.time : this.editor.snapped(this.timeAt(event), event.altKey);
      const amount = this.known.range ? this.valueUnder(event) - grasp.key.value : 0;
      return this.editor.shift(grasp.keys, time - grasp.key.time, amount, this);
    }
    const changes = event.shiftKey ? {} : { time: this.between(grasp.key, this.timeAt(event), event.altKey) };
    if (this.known.range) changes.value = this.valueUnder(event);
    grasp.key = this.editor.direction.change(grasp.key, changes);
    this.editor.select(grasp.key, this);
  }

  letGo() {
    this.box = null;
    this.editor.drawBox(null);
    if (!this.grasp) return;
    this.grasp = null;
    this.editor.direction.release();
  }

  /** A time for a key that keeps it between its neighbours, and on a frame unless it is free. */
  between(key, time, free) {
    const { keys } = this;
    const place = keys.indexOf(key), apart = this.editor.snaps && !free ? 1 / this.facts.frameRate : 0.001;
    const from = place > 0 ? keys[place - 1].time + apart : 0;
    const to = place + 1 < keys.length ? keys[place + 1].time - apart : Infinity;
    const wanted = this.editor.snapped(time, free);
    return wanted < from - SAME_TIME || wanted > to + SAME_TIME ? key.time : wanted;
  }

  // Keyboard.

  type(event) {
    const { editor } = this, { direction } = editor, { view } = this;
    const selected = editor.selected && editor.selected.channel === this.name ? editor.selected : null;
    const extend = (by) => {
      const next = this.keys[selected ? this.keys.indexOf(selected) + by : by > 0 ? 0 : this.keys.length - 1];
      if (next) editor.choose([...editor.chosen.filter((key) => key !== next), next], this);
    };
    if (event.ctrlKey || event.metaKey) {
      const own = {
        a: () => editor.choose(this.keys, this),
        c: () => editor.copyKeys(),
        x: () => editor.copyKeys() && editor.removeKeys(),
        v: () => editor.pasteKeys(this),
        ArrowLeft: () => extend(-1),
        ArrowRight: () => extend(1),
      }[event.key.length === 1 ? event.key.toLowerCase() : event.key];
      if (!own) return;
      event.preventDefault();
      event.stopPropagation();
      own();
      return;
    }
    const frame = 1 / this.facts.frameRate;
    const go = (by) => {
      const { keys } = this;
      const next = selected ? keys.indexOf(selected) + by : by > 0 ? 0 : keys.length - 1;
      if (!keys[next]) return;
      editor.select(keys[next], this);
      this.onSeek(Math.min(this.facts.frames - 1, Math.floor(keys[next].time / frame + FRAME_LEEWAY)));
    };
    const several = editor.chosen.length > 1;
    const move = (by) => {
      if (several) editor.shift(editor.chosen, by * frame, 0, this);
      else if (selected) editor.select(direction.change(selected, { time: this.between(selected, selected.time + by * frame) }), this);
    };
    const raise = (share) => {
      if (!selected || !this.known.range) return;
      editor.shift(editor.chosen, 0, share * (this.seen[1] - this.seen[0]), this);
    };
    const bend = (interpolation) => selected && editor.bend(interpolation, this);
    const actions = {
      ArrowLeft: () => (event.shiftKey ? move(-1) : go(-1)),
      ArrowRight: () => (event.shiftKey ? move(1) : go(1)),
      ArrowUp: () => raise(event.shiftKey ? 0.005 : 0.025),
      ArrowDown: () => raise(event.shiftKey ? -0.005 : -0.025),
      Enter: () => this.add(editor.time),
      Insert: () => this.add(editor.time),
      Delete: () => selected && editor.removeKeys(),
      Backspace: () => selected && editor.removeKeys(),
      "+": () => view.zoom(1.5, editor.time),
      "-": () => view.zoom(1 / 1.5, editor.time),
      0: () => view.set(0, view.seconds),
      PageUp: () => view.scroll(-0.5),
      PageDown: () => view.scroll(0.5),
      v: () => this.zoomValue(1.5),
      V: () => this.zoomValue(1 / 1.5),
      f: () => this.known.range && this.fit(),
      Escape: () => editor.select(null, this),
      1: () => bend("step"),
      2: () => bend("linear"),
      3: () => bend("smooth"),
    };
    const action = actions[event.key];
    if (!action) return;
    event.preventDefault();
    event.stopPropagation();
    action();
  }

  // Drawing.

  draw() {
    const pen = this.pen();
    const { colour } = pen;
    const { keys, seen } = this;
    const left = MARGIN.left, right = MARGIN.left + this.width;
    pen.fillStyle = colour("--raised");
    pen.fillRect(left, 0, this.width, pen.high);
    pen.fillStyle = colour("--quiet");
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    if (this.known.range) for (const value of seen) pen.fillText(String(Number(value.toFixed(2))), left - 8, this.y(value));
    pen.strokeStyle = colour("--line");
    pen.lineWidth = 1;
    pen.save();
    this.clip(pen, 8);
    const level = Math.round(this.y(this.known.rest)) + 0.5;
    pen.beginPath();
    pen.moveTo(left, level);
    pen.lineTo(right, level);
    pen.stroke();
    if (keys.length) this.drawCurve(pen, keys, left, right);
    keys.forEach((key) => this.drawKey(pen, key));
    pen.restore();
    this.point(this.shown ?? Math.max(0, this.editor.player.shown));
    this.describe(keys);
  }

  drawCurve(pen, keys, left, right) {
    pen.strokeStyle = pen.colour("--accent");
    pen.lineWidth = 1.75;
    pen.beginPath();
    if (!this.known.range) { // texts: a line as long as a text holds, and a gap where it changes
      pen.moveTo(left, this.y());
      pen.lineTo(right, this.y());
      pen.stroke();
      return;
    }
    const slopes = slopesOf(keys);
    for (let x = left; x <= right; x++) {
      pen.lineTo(x, this.y(valueAt(keys, this.view.from + ((x - left) / this.width) * this.view.span, this.range, 0, slopes)));
    }
    pen.stroke();
  }

  /** A key's shape says how the curve goes on: a square for a step, a diamond for a line, a disc for smooth. */
  drawKey(pen, key) {
    const x = this.x(key.time), y = this.y(key.value), chosen = this.editor.chosen.includes(key);
    const size = chosen ? 6.5 : 5;
    pen.beginPath();
    if (key.interpolation === "smooth") pen.arc(x, y, size, 0, 2 * Math.PI);
    else {
      pen.save();
      pen.translate(x, y);
      if (key.interpolation === "linear") pen.rotate(Math.PI / 4);
      pen.rect(-size + 0.5, -size + 0.5, 2 * size - 1, 2 * size - 1);
      pen.restore();
    }
    pen.fillStyle = pen.colour(chosen ? "--accent" : "--raised");
    pen.strokeStyle = pen.colour(chosen ? "--ink" : "--accent");
    pen.lineWidth = 2;
    pen.fill();
    pen.stroke();
    if (this.known.range) return;
    pen.fillStyle = pen.colour("--ink");
    pen.textAlign = "left";
    pen.fillText(key.value, x + 9, y - 11);
  }

  /** Words for those who do not see the lane. */
  describe(keys) {
    const at = keys.indexOf(this.editor.selected);
    const several = this.editor.chosen.length > 1 ? `, ${this.editor.chosen.length} keys chosen` : "";
    const words = at < 0 ? `${keys.length} keys` : `key ${at + 1} of ${keys.length}: ${sayKey(keys[at])}${several}`;
    this.canvas.setAttribute("aria-label", `${this.name}, ${words}`);
  }

  /** What changes from frame to frame. */
  show(time) {
    const value = this.editor.direction.value(this.name, time);
    const words = typeof value === "number" ? short(value) : value;
    if (this.now.textContent !== words) this.now.textContent = words;
  }
}

const sayKey = ({ time, value, interpolation }) =>
  `${short(time)} s, ${typeof value === "number" ? short(value) : value}, ${interpolation}`;
