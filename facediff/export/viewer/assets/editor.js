// The editor of a direction: lanes, the fields of the chosen key, undo, files, and the command that animates again.

/** A word as a shell takes it. */
const quoted = (word) => (/^[\w./:=,+@-]+$/.test(word) ? word : `'${word.replaceAll("'", `'\\''`)}'`);

/** The options of a take, from its metadata; a file from elsewhere may hold anything, but no output and no other model. */
const optionWords = (text, turned) => {
  let words = [];
  try {
    words = JSON.parse(text ?? "[]");
  } catch {
    return [];
  }
  const strings = Array.isArray(words) ? words.filter((word) => typeof word === "string") : [];
  const known = strings.every((word) => !word.startsWith("-") || /^--(?!output|checkpoint|yes)[a-z-]+$|^-[\d.]+$/.test(word));
  if (!known) return [];
  return (turned.length ? withoutRules(strings, turned) : strings).map(quoted);
};

/** Options without those whose work has been turned into keys; their seed stays for the others. */
const withoutRules = (words, turned) => {
  const left = turned.map((name) => `--${name}`);
  const others = ["--acting", "--blinks", "--gaze", "--sway"].some((name) => words.includes(name) && !left.includes(name));
  if (!others) left.push("--controls-seed");
  let dropped = false;
  return words.filter((word) => {
    if (word.startsWith("--")) dropped = left.includes(word);
    return !dropped;
  });
};

/** How far straight lines between keys may be from each frame; 0.05 degrees for the head. */
const TOLERANCES = { brows: 0.03, lids: 0.01 };

async function readFields(fields, vertices) {
  const read = (blob) => readField(blob, fields.step, vertices);
  const shapes = Object.entries(fields.shapes).map(async ([name, blob]) => [name, await read(blob)]);
  const [browsUp, browsDown, closing] = await Promise.all([fields.browsUp, fields.browsDown, fields.closing].map(read));
  return { browsUp, browsDown, closing, shapes: Object.fromEntries(await Promise.all(shapes)) };
}

class Editor {
  constructor(player) {
    this.player = player;
    this.facts = player.facts;
    this.number = Math.max(0, this.facts.animations.findIndex(({ direction }) => direction));
    this.directions = this.facts.animations.map(
      ({ direction, insteadOf }) => new Direction(this.facts.direction, direction ?? [], () => this.changed(), insteadOf)
    );
    this.lanes = [];
    this.chosen = []; // keys; the last one is that of the fields
    this.copied = [];
    this.drawing = null;
    this.connect();
    this.show(this.facts.animations.some(({ direction }) => direction));
    this.direct(this.number);
  }

  get selected() {
    return this.chosen.at(-1) ?? null;
  }

  /** Whether a drag in a lane draws a box around keys, as with Shift. */
  get boxing() {
    return find("box").getAttribute("aria-pressed") === "true";
  }

  get direction() {
    return this.directions[this.number];
  }

  /** Time of the shown frame in s. */
  get time() {
    const { shown, wanted } = this.player;
    return (shown < 0 ? wanted : shown) / this.facts.frameRate; // none is shown while changed keys are being drawn
  }

  get snaps() {
    return find("snap").checked;
  }

  /** A time on the nearest frame, if the page snaps; free is what asks for an exception. */
  snapped(time, free = false) {
    const { frames, frameRate } = this.facts;
    return this.snaps && !free ? Math.min(frames - 1, Math.round(time * frameRate)) / frameRate : Number(time.toFixed(4));
  }

  connect() {
    const click = (id, action) => find(id).addEventListener("click", action);
    click("directing", () => this.show(find("direction").hidden));
    click("undo", () => this.direction.undo());
    click("redo", () => this.direction.redo());
    click("delete-key", () => this.removeKeys());
    click("copy-keys", () => this.copyKeys());
    click("paste-keys", () => this.pasteKeys());
    click("turn-into-keys", () => this.turnIntoKeys());
    find("mood").append(...Object.keys(this.facts.direction.moods).map((name) => new Option(name, name)));
    find("mood").addEventListener("change", () => {
      this.setMood(find("mood").value);
      find("mood").value = "";
    });
    click("box", () => find("box").setAttribute("aria-pressed", String(!this.boxing)));
    const { view } = this.player;
    click("time-closer", () => view.zoom(1.5, this.time));
    click("time-further", () => view.zoom(1 / 1.5, this.time));
    click("time-all", () => view.set(0, view.seconds));
    find("time-from").addEventListener("input", () => view.set(Number(find("time-from").value), view.span));
    click("save-keys", () => this.save());
    click("open-keys", () => find("keys-file").click());
    find("keys-file").addEventListener("change", () => this.open(find("keys-file")));
    click("copy", () => this.copy());
    find("preview").addEventListener("change", () => this.player.redraw());
    find("directed").append(...this.facts.animations.map(({ name }, number) => new Option(name, number)));
    find("directed").hidden = this.facts.animations.length < 2;
    find("directed").addEventListener("change", () => this.direct(Number(find("directed").value)));
    find("add-channel").addEventListener("change", () => {
      const name = find("add-channel").value;
      if (name) this.addLane(name).canvas.focus();
      this.changed();
    });
    const field = (id, changes) =>
      find(id).addEventListener("change", () => {
        const words = find(id).value.trim();
        if (this.chosen.length > 1 && id === "key-kind") this.bend(words);
        else if (this.selected && (words || id === "key-slope")) this.select(this.direction.change(this.selected, changes(words)));
        this.showFields();
      });
    field("key-time", (words) => ({ time: Number(words) }));
    field("key-value", (words) => ({ value: this.direction.channel(this.selected.channel).range ? Number(words) : words }));
    field("key-kind", (words) => ({ interpolation: words }));
    field("key-slope", (words) => ({ slope: words === "" ? undefined : Number(words) }));
    addEventListener("keydown", (event) => this.type(event));
    addEventListener("beforeunload", (event) => {
      if (this.directions.some(({ unsaved }) => unsaved)) event.preventDefault();
    });
  }

  type(event) {
    if (find("direction").hidden || !(event.ctrlKey || event.metaKey) || event.altKey) return;
    if (event.target.closest?.("input[type=text], input[type=number]")) return; // its own history
    const key = event.key.toLowerCase();
    if (key !== "z" && key !== "y") return;
    event.preventDefault();
    if (key === "y" || event.shiftKey) this.direction.redo();
    else this.direction.undo();
  }

  /** Show in a frame's positions what changed keys do to it. */
  async readPreviews(faces) {
    this.previews = await Promise.all(faces.map(async ({ animation }, number) => {
      const entries = Object.entries(animation.weights).map(async ([name, blob]) => [
        name, Float32Array.from(new Uint8Array(await readBlob(blob)), (weight) => weight / 255)]);
      const made = new Direction(this.facts.direction, [], () => {});
      made.keys = this.directions[number].keys;
      const head = animation.head === null ? null : new Float32Array(await readBlob(animation.head));
      const fields = animation.fields && (await readFields(animation.fields, animation.vertices));
      const curve = async (blob) => new Float32Array(await readBlob(blob));
      const acted = animation.acted && {
        acting: Object.fromEntries(await Promise.all(Object.entries(animation.acted.acting).map(async ([name, blob]) => [name, await curve(blob)]))),
        blinks: animation.acted.blinks === null ? null : await curve(animation.acted.blinks),
      };
      return new Preview(this.facts, animation, Object.fromEntries(await Promise.all(entries)), head, made, fields, acted);
    }));
    this.changed();
  }

  /** Whether the page shows what keys of a channel do. */
  canPreview(name) {
    return !this.previews || this.previews[this.number].shows(name);
  }

  /** The options, acting and blinks, whose work the keys do not stand for yet. */
  get rules() {
    const acted = this.previews && this.previews[this.number].acted, { turned } = this.direction.keys;
    if (!acted) return [];
    return [...(Object.keys(acted.acting).length ? ["acting"] : []), ...(acted.blinks ? ["blinks"] : [])].filter((name) => !turned.includes(name));
  }

  /** Replace what acting and blinking did by keys of the same motion, which can be edited. */
  turnIntoKeys() {
    const preview = this.previews[this.number], { direction, rules } = this, { acting } = preview.acted;
    const names = [...new Set([...(rules.includes("acting") ? Object.keys(acting) : []), ...(rules.includes("blinks") ? ["lids"] : [])])];
    const rows = names.flatMap((name) => preview.reduced(direction, name, TOLERANCES[name] ?? 0.05));
    const left = direction.keys.filter(({ channel }) => !names.includes(channel) && !(channel === "acting" && rules.includes(channel)));
    direction.set([...left, ...rows.map(Object.freeze)], [...direction.keys.turned, ...rules]);
    find("direction-said").textContent = `${rows.length} keys in place of ${rules.join(" and ")}; the command leaves out the options that made them`;
  }

  /** A mood's keys at the beginning, in place of other keys of its channels. */
  setMood(name) {
    const rows = this.facts.direction.moods[name], { direction } = this;
    const channels = new Set(rows.map(({ channel }) => channel));
    direction.set([...direction.keys.filter(({ channel }) => !channels.has(channel)), ...rows.map((row) => Object.freeze({ ...row }))]);
    find("direction-said").textContent = `${name}: ${rows.length} keys from beginning to end, as --direction ${name} has them`;
  }

  preview(number, face, frame) {
    if (!find("preview").checked || !this.previews) return;
    this.previews[number].apply(face.positions, face.template, frame, this.directions[number]);
  }

  /** Open the editor, or close it. */
  show(on) {
    find("direction").hidden = !on;
    document.body.classList.toggle("directed", on);
    find("directing").setAttribute("aria-pressed", String(on));
  }

  /** Edit the direction of another animation. */
  direct(number) {
    this.number = number;
    find("directed").value = number;
    for (const lane of this.lanes) lane.leave();
    this.lanes = [];
    this.chosen = [];
    this.changed();
  }

  addLane(name) {
    const there = this.lanes.find((lane) => lane.name === name);
    if (there) return there;
    const lane = new Lane(this, name);
    this.lanes.push(lane);
    find("lanes").append(lane.element);
    return lane;
  }

  removeLane(lane) {
    this.lanes = this.lanes.filter((each) => each !== lane);
    lane.leave();
    this.direction.removeChannel(lane.name);
    this.changed();
  }

  /** Choose a key, or none. */
  select(key, lane) {
    this.choose(key ? [key] : [], lane);
  }

  /** Choose a key as well, or no longer. */
  toggle(key, lane) {
    const left = this.chosen.filter((other) => other !== key);
    this.choose(left.length < this.chosen.length ? left : [...left, key], lane);
  }

  /** Choose keys. */
  choose(keys, lane) {
    this.chosen = [...keys];
    const key = this.selected;
    if (lane && document.activeElement !== lane.canvas) lane.canvas.focus({ preventScroll: true });
    this.showFields();
    this.drawLanes();
    if (key) find("direction-said").textContent = keys.length > 1 ? `${keys.length} keys chosen` : `${key.channel}: ${sayKey(key)}`;
  }

  /** The focus has come to a lane: keys of another one are no longer chosen. */
  enter(lane) {
    if (this.selected && !this.chosen.some(({ channel }) => channel === lane.name)) this.select(null);
  }

  /** Draw all lanes before the next picture, once however much has changed. */
  drawLanes() {
    this.drawing ??= requestAnimationFrame(() => {
      this.drawing = null;
      for (const lane of this.lanes) lane.draw();
    });
  }

  /** What the view of the time has changed. */
  draw() {
    const { view } = this.player, from = find("time-from");
    from.hidden = view.whole;
    Object.assign(from, { min: 0, max: view.seconds - view.span, step: "any", value: view.from });
    from.setAttribute("aria-valuetext", `${short(view.from)} to ${short(view.to)} seconds`);
    find("time-all").disabled = find("time-further").disabled = view.whole;
    this.drawLanes();
  }

  // Several keys.

  removeKeys() {
    const keys = this.chosen;
    if (!keys.length) return;
    this.chosen = [];
    this.direction.remove(keys);
    const [{ channel, time }] = keys;
    find("direction-said").textContent = keys.length > 1 ? `removed ${keys.length} keys` : `${channel}: removed the key at ${short(time)} s`;
  }

  /** A time that was computed, on the frame that it means. */
  onFrame(time) {
    const frame = Math.round(time * this.facts.frameRate) / this.facts.frameRate;
    return Math.abs(frame - time) < SAME_TIME ? frame : Number(time.toFixed(6));
  }

  /** Move keys, as they were when they were grasped, by seconds, and those of a lane by an amount: all of them or none. */
  shift(keys, seconds, amount, lane) {
    const rows = keys.map((key) => ({
      ...key,
      time: this.onFrame(key.time + seconds),
      value: key.channel === lane.name && lane.known.range ? key.value + amount : key.value,
    }));
    this.put(this.chosen, rows, lane);
  }

  bend(interpolation, lane) {
    this.put(this.chosen, this.chosen.map((key) => ({ ...key, interpolation })), lane);
  }

  put(keys, rows, lane) {
    const placed = this.direction.replace(keys, rows);
    if (placed) this.choose(placed, lane);
  }

  copyKeys() {
    this.copied = [...this.chosen].sort((a, b) => a.time - b.time);
    find("direction-said").textContent = `copied ${this.copied.length} keys`;
    this.showFields();
    return this.copied.length > 0;
  }

  /** Put copies of keys at the shown frame: into their channels, or those of one channel of numbers into the lane in use. */
  pasteKeys(lane = this.lanes.find(({ canvas }) => canvas === document.activeElement)) {
    if (!this.copied.length) return;
    const [first] = this.copied, channels = new Set(this.copied.map(({ channel }) => channel));
    const other = lane && channels.size === 1 && lane.known.range && this.direction.channel(first.channel).range ? lane.name : null;
    const moved = this.onFrame(this.snapped(this.time)) - first.time;
    const rows = this.copied.map((key) => ({ ...key, channel: other ?? key.channel, time: this.onFrame(key.time + moved) }));
    const under = rows.map(({ channel, time }) => this.direction.at(channel, time)).filter(Boolean);
    this.put(under, rows, lane);
    find("direction-said").textContent = `pasted ${rows.length} keys at ${short(this.time)} s`;
  }

  /** Choose the keys of all lanes within a box from where it began to a pointer; without a box, show none. */
  drawBox(box, event, lane) {
    const frame = find("chosen-box");
    frame.hidden = !box;
    if (!box) return;
    const left = Math.min(box.x, event.clientX), right = Math.max(box.x, event.clientX);
    const top = Math.min(box.y, event.clientY), bottom = Math.max(box.y, event.clientY);
    Object.assign(frame.style, { left: `${left}px`, top: `${top}px`, width: `${right - left}px`, height: `${bottom - top}px` });
    const inside = this.lanes.flatMap((each) => {
      const place = each.canvas.getBoundingClientRect();
      return each.keys.filter((key) => {
        const x = place.left + each.x(key.time), y = place.top + each.y(key.value);
        return x >= left && x <= right && y >= top && y <= bottom;
      });
    });
    this.choose([...box.kept.filter((key) => !inside.includes(key)), ...inside], lane);
  }

  /** Bring the page up to date after a change of the keys. */
  changed() {
    const { direction } = this;
    const now = (key) => (direction.keys.includes(key) ? key : direction.at(key.channel, key.time));
    this.chosen = this.chosen.map(now).filter(Boolean);
    for (const name of direction.channels) this.addLane(name);
    this.drawLanes();
    const acted = this.previews && this.previews[this.number].acted;
    find("turn-into-keys").hidden = !acted;
    find("turn-into-keys").disabled = !this.rules.length;
    for (const lane of this.lanes) lane.later.hidden = this.canPreview(lane.name);
    find("paste-keys").disabled = !this.copied.length;
    find("undo").disabled = !direction.past.length;
    find("redo").disabled = !direction.future.length;
    find("save-keys").disabled = !direction.keys.length;
    find("no-lanes").hidden = this.lanes.length > 0;
    this.offerChannels();
    this.showFields();
    this.showCommand();
    this.showTime();
    this.player.redraw();
  }

  /** The channels that have no lane yet. */
  offerChannels() {
    const { regions } = this.facts.animations[this.number];
    const names = Object.entries(this.facts.direction.channels).flatMap(([name, channel]) =>
      channel.regions ? [name, ...Object.keys(regions).map((region) => `${name}.${region}`)] : [name]
    );
    const left = names.filter((name) => !this.lanes.some((lane) => lane.name === name));
    const shapes = make("optgroup");
    shapes.label = "ARKit's shapes";
    const of = (some) => some.map((name) => new Option(name, name));
    shapes.append(...of(left.filter((name) => name.startsWith("shape."))));
    find("add-channel").replaceChildren(new Option("Add a channel…", ""), ...of(left.filter((name) => !name.startsWith("shape."))), shapes);
  }

  showFields() {
    const key = this.selected;
    find("key-fields").hidden = !key;
    find("paste-keys").disabled = !this.copied.length;
    if (!key) return;
    const several = this.chosen.length > 1;
    for (const id of ["key-time", "key-value"]) find(id).parentElement.hidden = several;
    find("delete-key").textContent = several ? "Delete keys" : "Delete key";
    const { range } = this.direction.channel(key.channel);
    const value = find("key-value");
    find("key-channel").textContent = several ? `${this.chosen.length} keys` : key.channel;
    find("key-time").value = short(key.time);
    find("key-time").step = this.snaps ? 1 / this.facts.frameRate : "any";
    value.type = range ? "number" : "text";
    if (range) Object.assign(value, { min: range[0], max: range[1], step: "any" });
    value.value = range ? short(key.value) : key.value;
    find("key-kind").value = key.interpolation;
    find("key-slope").value = key.slope ?? "";
    find("key-slope").parentElement.hidden = several || !range || key.interpolation !== "smooth";
  }

  showTime() {
    for (const lane of this.lanes) lane.show(this.time);
  }

  /** What changes from frame to frame. */
  point(frame) {
    for (const lane of this.lanes) lane.point(frame);
    this.showTime();
  }

  // Files and commands.

  fileOf(number) {
    return `${fileName(this.facts.animations[number].name)}_keys.json`;
  }

  /** The command that animates again with the keys. Only what the page knows is in it. */
  showCommand() {
    const { metadata } = this.facts.animations[this.number];
    const words = ["facediff", "animate", quoted(metadata.recording ?? "SPEECH.wav"), "--still", "--checkpoint", quoted(metadata.checkpoint ?? "CHECKPOINT")];
    const directed = this.direction.of("style").length > 0; // then the style of the take is not one for all of it
    for (const name of ["identity", ...(directed ? [] : ["style"]), "seed", "expressivity", "guidance"]) {
      if (/^[\w.=,-]+$/.test(metadata[name] ?? "")) words.push(`--${name}`, metadata[name]); // not "zoe (not trained on)"
    }
    words.push(...optionWords(metadata.options, this.direction.keys.turned));
    words.push("--direction", quoted(this.fileOf(this.number)), "-o", "take.html");
    find("command").textContent = words.join(" ");
  }

  save(number = this.number) {
    const direction = this.directions[number];
    download(this.fileOf(number), "application/json", [direction.text()]);
    direction.saved = direction.keys;
    find("direction-said").textContent = `saved ${this.fileOf(number)}; the command below animates again with it`;
  }

  async open(input) {
    const [file] = input.files;
    input.value = ""; // the same file can be opened again
    if (!file) return;
    try {
      this.direction.open(await file.text());
      find("direction-said").textContent = `opened ${file.name}: ${this.direction.keys.length} keys`;
    } catch (error) {
      find("direction-said").textContent = `${file.name}: ${error.message}; nothing was changed`;
    }
  }

  async copy() {
    const text = find("command").textContent;
    try {
      await navigator.clipboard.writeText(text);
      find("direction-said").textContent = "copied the command";
    } catch { // no clipboard for pages of this kind: select it, so that a key press copies
      getSelection().selectAllChildren(find("command"));
      find("direction-said").textContent = "the command is selected: copy it with Ctrl+C";
    }
  }
}
