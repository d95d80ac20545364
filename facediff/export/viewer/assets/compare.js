// Where on the stage each animation goes: side by side, or two takes in one panel to be compared.

/** Ways to compare two takes, in the order of the menu. */
const LAYOUTS = {
  side: "Side by side",
  switch: "A/B switch",
  blink: "A/B blink",
  wipe: "Wipe",
  overlay: "Overlay",
};
const BLINK_MS = 600;

/** A colour of the style sheet, "#rrggbb", and an opacity as the scene takes them. */
function inkOf(hex, opacity) {
  return [...[1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16) / 255), opacity];
}

const calm = matchMedia("(prefers-reduced-motion: reduce)");

class Comparison {
  /** Args: the page's facts, the boxes of labels in the order of the animations, and what is done when the picture changes. */
  constructor(facts, boxes, onChange) {
    Object.assign(this, { facts, boxes, onChange });
    this.layout = "side";
    this.first = 0;
    this.second = 1;
    this.shown = 0; // of the switch: 0 for A, 1 for B
    this.share = 0.5; // of the wipe: how much of the width is A's
    const possible = boxes.length > 1;
    find("compare").hidden = !possible;
    if (!possible) return;
    for (const [name, words] of Object.entries(LAYOUTS)) find("layout").append(new Option(words, name));
    for (const id of ["first", "second"]) {
      find(id).append(...facts.animations.map(({ name }, number) => new Option(name, number)));
      find(id).addEventListener("change", () => this.choose(id, Number(find(id).value)));
    }
    find("layout").addEventListener("change", () => this.arrange(find("layout").value));
    find("swap").addEventListener("click", () => this.swap());
    const rest = () => {
      for (const option of find("layout").options) option.disabled = option.value === "blink" && calm.matches;
      if (this.layout === "blink" && calm.matches) this.arrange("switch");
    };
    calm.addEventListener("change", rest);
    rest();
    this.connectDivider();
    this.arrange("side");
  }

  /** Show A and B in another way. */
  arrange(layout) {
    if (!(layout in LAYOUTS)) throw new Error(`no layout "${layout}"; there are ${Object.keys(LAYOUTS).join(", ")}`);
    this.layout = layout === "blink" && calm.matches ? "switch" : layout;
    find("layout").value = this.layout;
    clearInterval(this.timer);
    if (this.layout === "blink") this.timer = setInterval(() => this.swap(), BLINK_MS);
    this.show();
  }

  choose(id, number) {
    const other = id === "first" ? "second" : "first";
    if (this[other] === number) this[other] = this[id]; // they change places
    this[id] = number;
    this.show();
  }

  /** The other one of A and B; where both are seen, they change places. */
  swap() {
    if (this.boxes.length < 2) return;
    if (this.layout === "side") this.arrange("switch");
    if (this.switches) this.shown = 1 - this.shown;
    else [this.first, this.second] = [this.second, this.first];
    this.show();
  }

  get paired() {
    return this.layout !== "side";
  }

  get switches() {
    return this.layout === "switch" || this.layout === "blink";
  }

  /** Numbers of the animations that are seen. */
  get seen() {
    if (!this.paired) return this.boxes.map((_, number) => number);
    return this.switches ? [this.shown ? this.second : this.first] : [this.first, this.second];
  }

  /** Bring the page's words and controls up to date. */
  show() {
    const { paired, seen, first, second } = this;
    find("panels").classList.toggle("pair", paired);
    this.boxes.forEach(({ box, letter }, number) => {
      box.hidden = paired && number !== first && number !== second;
      box.classList.toggle("away", !seen.includes(number));
      box.classList.toggle("right", paired && number === second);
      box.classList.toggle("edges", this.layout === "overlay" && number === second);
      letter.hidden = !paired;
      letter.textContent = number === first ? "A" : "B";
    });
    for (const id of ["first", "second"]) {
      find(id).hidden = !paired || this.boxes.length < 3;
      find(id).value = this[id];
    }
    find("swap").textContent = this.switches ? `Show ${this.shown ? "A" : "B"}` : "Swap";
    find("swap").hidden = !paired || this.layout === "blink";
    find("divider").hidden = this.layout !== "wipe";
    this.moveDivider(this.share);
    this.onChange();
  }

  connectDivider() {
    const divider = find("divider"), stage = find("stage");
    divider.addEventListener("pointerdown", (event) => {
      event.stopPropagation(); // the stage would turn the faces
      divider.setPointerCapture(event.pointerId);
    });
    divider.addEventListener("pointermove", (event) => {
      event.stopPropagation();
      const box = stage.getBoundingClientRect();
      if (event.buttons & 1) this.moveDivider((event.clientX - box.left) / box.width);
    });
    divider.addEventListener("dblclick", (event) => event.stopPropagation());
    divider.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key];
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      this.moveDivider(this.share + step);
    });
  }

  moveDivider(share) {
    this.share = Math.max(0, Math.min(1, share));
    find("divider").style.left = `${100 * this.share}%`;
    find("divider").setAttribute("aria-valuenow", Math.round(100 * this.share));
    this.onChange();
  }

  /** The views that the scene draws: see Scene.draw. */
  views() {
    const stage = find("stage").getBoundingClientRect();
    if (!stage.width || !stage.height) return [];
    if (!this.paired) {
      const places = this.boxes.map(({ box }) => box.getBoundingClientRect());
      const inset = this.inset(places);
      return places.map(({ left, top, width, height }, number) => ({
        number,
        place: [(left - stage.left) / stage.width, (top - stage.top) / stage.height, width / stage.width, height / stage.height],
        inset,
      }));
    }
    const whole = { place: [0, 0, 1, 1], inset: this.inset([stage]) };
    const { first, second, share } = this;
    if (this.switches) return [{ ...whole, number: this.seen[0] }];
    if (this.layout === "wipe") {
      return [{ ...whole, number: first, part: [0, share] }, { ...whole, number: second, part: [share, 1] }];
    }
    const colour = getComputedStyle(find("stage")).getPropertyValue("--overlay").trim();
    return [{ ...whole, number: first }, { ...whole, number: second, ink: inkOf(colour, 0.8) }];
  }

  /**
   * Shares of the panels' height above and below the faces for the words over them: none where the words stand beside the
   * faces, as they do in wide panels. All panels have the same, so that the faces keep one scale.
   */
  inset(places) {
    const extent = [0, 1].map((axis) => Math.max(...this.facts.animations.map((animation) => animation.extent[axis])));
    const { width, height } = places[0];
    const half = Math.min(width / 2, ((height / 2) * extent[0]) / extent[1]); // of the face's width, at least
    const left = width / 2 - half, right = width / 2 + half;
    let above = 0, below = 0;
    for (const { box, over, foot } of this.boxes) {
      if (box.hidden) continue;
      const panel = this.paired ? find("stage").getBoundingClientRect() : box.getBoundingClientRect();
      const meets = (words) => words.width > 0 && words.right - panel.left > left && words.left - panel.left < right;
      for (const element of over) {
        const words = element.getBoundingClientRect();
        if (meets(words)) above = Math.max(above, words.bottom - panel.top + 4);
      }
      for (const element of foot.children) {
        const words = element.getBoundingClientRect();
        if (meets(words)) below = Math.max(below, panel.bottom - words.top + 4);
      }
    }
    // In a very low window a face half hidden by words is better than none.
    const most = 0.5 * height, used = Math.max(1, (above + below) / most);
    return [above / used / height, below / used / height];
  }
}
