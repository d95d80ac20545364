// The controls, and the labels over the faces.

/** Pixels that a panel's words need: across beside the face, or above and below it together. */
const ACROSS = 150, UPRIGHT = 90;

/** Columns of the grid in which `count` faces, a little taller than wide, become largest. */
function columnsFor(count, width, height) {
  let best = 1, most = 0;
  for (let columns = 1; columns <= Math.min(count, Math.ceil(width / 250)); columns++) {
    const wide = width / columns, high = height / Math.ceil(count / columns);
    const size = Math.max(Math.min(wide - 2 * ACROSS, 0.8 * high), Math.min(wide, 0.8 * (high - UPRIGHT)));
    if (size > most * 1.001) [best, most] = [columns, size];
  }
  return best;
}

class Panels {
  constructor(facts, onChange) {
    this.facts = facts;
    this.boxes = facts.animations.map((animation, number) => this.label(animation, number));
    find("panels").append(...this.boxes.map(({ box }) => box));
    new ResizeObserver(() => {
      const { clientWidth, clientHeight } = find("stage");
      find("panels").style.setProperty("--columns", columnsFor(facts.animations.length, clientWidth, clientHeight));
      onChange();
    }).observe(find("stage"));
  }

  label(animation, number) {
    const box = make("div", "panel");
    const head = make("div", "name");
    const letter = make("span", "letter"); // A or B, where two are compared
    letter.hidden = true;
    head.append(make("i", `swatch line-${number + 1}`), letter, make("b", "", animation.name));
    if (number === this.facts.truth && animation.name.toLowerCase() !== "truth") head.append(make("span", "mark", "truth"));
    const { words, marks } = captions(animation);
    const error = make("p", "error");
    const foot = make("div", "marks"); // below the face, where the marks hide nothing
    foot.append(...marks.map((mark) => make("p", "mark", mark)));
    const about = make("p", "words");
    about.append(...words.map((each) => make("span", "", each)));
    box.append(head, about, error, foot);
    const opening = make("span", "value");
    return { box, letter, error, opening, over: [head, about, error], foot };
  }

  /** Give the controls something to control. */
  connect(player, ramp) {
    const { facts } = this;
    this.player = player;
    const scrub = find("scrub");
    scrub.max = facts.frames - 1;
    scrub.addEventListener("input", () => player.seek(Number(scrub.value)));
    const click = (id, action) => find(id).addEventListener("click", action);
    click("play", () => player.toggle());
    click("back", () => player.step(-1));
    click("forward", () => player.step(1));
    click("loop", () => this.press("loop", (player.clock.loop = !this.pressed("loop"))));
    click("mute", () => this.press("mute", (find("sound").muted = !this.pressed("mute"))));
    click("heat", () => player.setHeat(!player.heat));
    click("wireframe", () => player.setEdges(!player.edges));
    click("reset", () => player.camera.reset());
    find("speed").addEventListener("change", () => (player.clock.speed = Number(find("speed").value)));
    find("mute").hidden = facts.sound === null;
    find("heat").hidden = !facts.heat;
    find("highest").addEventListener("change", () => {
      player.highest = Math.max(0.01, Number(find("highest").value) || facts.heat.highest);
      this.showHeat(player.heat, player.highest);
      player.dirty = true;
    });
    addEventListener("keydown", (event) => this.key(event));
    if (ramp) this.paintKey(ramp);
    for (const { opening } of this.boxes) opening.hidden = true;
    player.faces.forEach((face, number) => {
      if (!face.opening) return;
      const entry = make("span", "entry");
      entry.append(make("i", `swatch line-${number + 1}`), make("span", "", face.animation.name), this.boxes[number].opening);
      this.boxes[number].opening.hidden = false;
      find("legend").append(entry);
    });
  }

  pressed(id) {
    return find(id).getAttribute("aria-pressed") === "true";
  }

  press(id, on) {
    find(id).setAttribute("aria-pressed", String(on));
  }

  key(event) {
    const { player } = this;
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (event.target.closest("select, input:not([type=range])")) return;
    if (event.key === " " && event.target.closest("button")) return; // the button's own key
    const leap = event.shiftKey ? Math.round(this.facts.frameRate) : 1;
    const actions = {
      " ": () => player.toggle(),
      ArrowLeft: () => player.step(-leap),
      ArrowRight: () => player.step(leap),
      Home: () => player.seek(0),
      End: () => player.seek(this.facts.frames - 1),
      "+": () => player.camera.magnify(1.15),
      "-": () => player.camera.magnify(1 / 1.15),
      a: () => player.camera.turn(-0.1, 0),
      d: () => player.camera.turn(0.1, 0),
      w: () => player.camera.turn(0, 0.1),
      s: () => player.camera.turn(0, -0.1),
      l: () => find("loop").click(),
      h: () => find("heat").click(),
      e: () => find("wireframe").click(),
      k: () => find("directing").click(),
      x: () => player.comparison.swap(),
      m: () => find("mute").click(),
      r: () => find("reset").click(),
      i: () => find("information").showModal(),
      "?": () => find("keys").showModal(),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }

  paintKey(ramp) {
    const canvas = find("ramp");
    canvas.width = ramp.length / 3;
    canvas.height = 1;
    const picture = new ImageData(canvas.width, 1);
    for (let i = 0; i < canvas.width; i++) picture.data.set([...ramp.subarray(3 * i, 3 * i + 3), 255], 4 * i);
    canvas.getContext("2d").putImageData(picture, 0, 0);
  }

  showHeat(on, highest) {
    this.press("heat", on);
    find("key").hidden = !on;
    find("highest").value = highest;
    if (!on) for (const { error } of this.boxes) error.textContent = "";
  }

  showError(number, { mean, largest }) {
    this.boxes[number].error.textContent = `mean ${mean.toFixed(2)} mm\nlargest ${largest.toFixed(2)} mm`;
  }

  /** What changes from frame to frame. */
  showState(player) {
    if (this.playing !== player.playing) {
      this.playing = player.playing;
      find("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
      find("play").classList.toggle("playing", this.playing);
    }
    if (this.shown === player.shown || player.shown < 0) return;
    this.shown = player.shown;
    const { frames, frameRate } = this.facts;
    find("scrub").value = this.shown;
    find("scrub").style.setProperty("--done", frames > 1 ? this.shown / (frames - 1) : 1);
    find("scrub").setAttribute("aria-valuetext", `frame ${this.shown}, ${(this.shown / frameRate).toFixed(2)} seconds`);
    find("time").textContent = `${seconds(this.shown / frameRate)} / ${seconds(frames / frameRate)}`;
    find("frame").textContent = `frame ${this.shown} / ${frames - 1}`;
    player.faces.forEach(({ opening }, number) => {
      if (opening) this.boxes[number].opening.textContent = `${opening[this.shown].toFixed(1)} mm`;
    });
  }
}
