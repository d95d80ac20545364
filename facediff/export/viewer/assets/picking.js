// Landmarks: the same places are picked on two faces, by pointer or keys, mirrored, and saved.

const SNAP = 0.995; // a place that weighs a corner by this is the corner
const CLICK = { mouse: 4, pen: 6, touch: 12 }; // pixels that a pointer may move in a click

const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const words = (name) => name.replaceAll("_", " ");

/** Where a place of a mesh is: corners of a triangle and their weights. */
function pointOf(face, { corners, weights }) {
  return [0, 1, 2].map((axis) => weights.reduce((sum, weight, k) => sum + weight * face.positions[3 * corners[k] + axis], 0));
}

function normalOf(face, { corners, weights }) {
  return [0, 1, 2].map((axis) => weights.reduce((sum, weight, k) => sum + weight * face.normals[3 * corners[k] + axis], 0));
}

/** A place; next to a corner, the corner. */
function placeAt(corners, weights) {
  const most = weights.indexOf(Math.max(...weights));
  if (weights[most] > SNAP) return { corners: Array(3).fill(corners[most]), weights: [1, 0, 0] };
  const kept = weights.map((weight) => Math.max(0, weight));
  const sum = kept.reduce((a, b) => a + b);
  return { corners: [...corners], weights: kept.map((weight) => weight / sum) };
}

const vertexPlace = (vertex) => ({ corners: [vertex, vertex, vertex], weights: [1, 0, 0] });
const asPlace = (value) => (typeof value === "number" ? vertexPlace(value) : value);
const asValue = ({ corners, weights }) => (weights[0] === 1 ? corners[0] : { corners, weights });

/** Weights of the point of a triangle that is nearest to a point: Ericson, Real-Time Collision Detection, 5.1.5. */
function nearestOnTriangle(p, a, b, c) {
  const ab = sub(b, a), ac = sub(c, a), ap = sub(p, a);
  const d1 = dot(ab, ap), d2 = dot(ac, ap);
  if (d1 <= 0 && d2 <= 0) return [1, 0, 0];
  const bp = sub(p, b), d3 = dot(ab, bp), d4 = dot(ac, bp);
  if (d3 >= 0 && d4 <= d3) return [0, 1, 0];
  const vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) return [1 - d1 / (d1 - d3), d1 / (d1 - d3), 0];
  const cp = sub(p, c), d5 = dot(ab, cp), d6 = dot(ac, cp);
  if (d6 >= 0 && d5 <= d6) return [0, 0, 1];
  const vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) return [1 - d2 / (d2 - d6), 0, d2 / (d2 - d6)];
  const va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) {
    const share = (d4 - d3) / (d4 - d3 + (d5 - d6));
    return [0, 1 - share, share];
  }
  const whole = 1 / (va + vb + vc);
  return [1 - (vb + vc) * whole, vb * whole, vc * whole];
}

/** One mesh with its camera: draws, finds what is under a point of the picture, and shows the numbered points. */
class Side {
  constructor(name, facts, face, app) {
    Object.assign(this, { name, facts, face, app });
    this.root = find(name);
    this.box = this.root.querySelector(".face");
    this.canvas = this.root.querySelector("canvas");
    this.overlay = this.root.querySelector(".marks");
    this.cross = this.root.querySelector(".cross");
    this.root.querySelector(".file").textContent = facts.name;
    this.box.setAttribute("aria-label", `${this.root.getAttribute("aria-label")}, ${facts.name}: arrow keys move a cross, Enter places the point`);
    this.extent = facts.extent;
    this.halves = facts.extent.map((half, axis) => [0, 1, 2].map((k) => (k === axis ? half : 0))); // they turn with it
    face.centre = facts.centre;
    this.edges = false;
    this.at = [0.5, 0.5]; // the cross, in shares of the box
    this.scene = new Scene(this.canvas, [face], null);
    this.canvas.addEventListener("webglcontextrestored", () => app.request()); // after the scene has built itself
    this.prepare();
    this.box.addEventListener("dblclick", (event) => event.stopImmediatePropagation()); // two quick clicks are no reset
    this.camera = new Camera(this.box, () => app.moved(this));
    this.listen();
    this.listParts(facts.parts ?? []);
    new ResizeObserver(() => app.request()).observe(this.box);
  }

  /** Normals, and what is on the graphics card. */
  prepare() {
    orient(this.face.normals, this.face.positions, this.face.faces);
    this.scene.fresh = true;
  }

  listen() {
    let pressed = null;
    this.box.addEventListener("pointerdown", (event) => {
      pressed = event.button === 0 && !event.shiftKey ? [event.clientX, event.clientY] : null;
      this.cross.hidden = true;
    });
    this.box.addEventListener("pointerup", (event) => {
      if (!pressed || Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]) > CLICK[event.pointerType || "mouse"]) return;
      pressed = null;
      const { left, top } = this.canvas.getBoundingClientRect();
      this.app.pick(this, event.clientX - left, event.clientY - top);
    });
    this.box.addEventListener("keydown", (event) => this.key(event));
    this.box.addEventListener("blur", () => (this.cross.hidden = true));
    for (const button of this.root.querySelectorAll("[data-action]")) {
      button.addEventListener("click", () => {
        const on = button.getAttribute("aria-pressed") !== "true";
        button.setAttribute("aria-pressed", String(on));
        if (button.dataset.action === "edges") this.edges = on;
        else this.frame(on);
        this.app.request();
      });
    }
    for (const button of this.root.querySelectorAll("[data-turn]")) {
      button.addEventListener("click", (event) => this.rotate(Number(button.dataset.turn), event.shiftKey ? 15 : 90));
    }
  }

  /** A box for each part, [name, [[first triangle, number of triangles], …]], that hides and shows it. */
  listParts(parts) {
    const menu = this.root.querySelector(".parts");
    if (!menu || parts.length < 2) return;
    menu.hidden = false;
    const whole = this.face.faces, hidden = new Set();
    for (const part of parts) {
      const label = document.createElement("label"), box = document.createElement("input");
      box.type = "checkbox";
      box.checked = true;
      box.addEventListener("change", () => {
        if (box.checked) hidden.delete(part);
        else hidden.add(part);
        this.face.faces = withoutParts(whole, [...hidden].flatMap(([, runs]) => runs));
        this.scene.sendFaces(0);
        this.app.request();
      });
      label.append(box, ` ${part[0]}`);
      menu.querySelector("div").append(label);
    }
  }

  /** Show the whole mesh, or the face. */
  frame(whole) {
    const { centre, extent } = whole ? this.facts.whole : this.facts;
    this.face.centre = centre;
    this.extent = extent;
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const { clientWidth, clientHeight } = this.canvas;
    if (steps[event.key]) {
      const far = event.shiftKey ? 24 : 3;
      const sizes = [clientWidth, clientHeight];
      this.at = this.at.map((value, axis) => Math.max(0, Math.min(1, value + (far * steps[event.key][axis]) / sizes[axis])));
      this.showCross();
    } else if (event.key === "Enter" || event.key === " ") {
      if (this.cross.hidden) this.showCross();
      else this.app.pick(this, this.at[0] * clientWidth, this.at[1] * clientHeight);
    } else return;
    event.preventDefault();
    event.stopPropagation();
  }

  showCross() {
    this.cross.hidden = false;
    Object.assign(this.cross.style, { left: `${100 * this.at[0]}%`, top: `${100 * this.at[1]}%` });
  }

  /** Turn the mesh by some degrees about an axis through the middle of the whole mesh. */
  rotate(axis, degrees) {
    const [one, two] = [(axis + 1) % 3, (axis + 2) % 3];
    const { centre, extent } = this.facts.whole;
    const c = Math.cos((degrees * Math.PI) / 180), s = Math.sin((degrees * Math.PI) / 180);
    const turn = (p) => {
      const a = p[one] - centre[one], b = p[two] - centre[two];
      p[one] = centre[one] + c * a - s * b;
      p[two] = centre[two] + s * a + c * b;
      return p;
    };
    const { positions } = this.face;
    for (let i = 0; i < positions.length; i += 3) turn(positions.subarray(i, i + 3));
    const away = (v) => sub(turn(v.map((part, k) => part + centre[k])), centre);
    const [x, y, z, offset] = this.facts.plane;
    const origin = turn([x * offset, y * offset, z * offset]), normal = away([x, y, z]);
    this.facts.plane = [...normal, dot(normal, origin)];
    this.facts.centre = turn([...this.facts.centre]);
    this.halves = this.halves.map(away);
    this.facts.extent = [0, 1, 2].map((k) => this.halves.reduce((sum, half) => sum + Math.abs(half[k]), 0));
    for (let k = 0; k < 3; k++) extent[k] = 0;
    for (let i = 0; i < positions.length; i++) extent[i % 3] = Math.max(extent[i % 3], Math.abs(positions[i] - centre[i % 3]));
    const whole = this.root.querySelector("[data-action=whole]");
    whole.setAttribute("aria-pressed", "true"); // where the face is now shows on the whole mesh
    this.frame(true);
    this.prepare();
    this.app.request();
  }

  matrices() {
    const { clientWidth, clientHeight } = this.canvas;
    return this.camera.matrices(this.face.centre, this.extent, clientWidth / Math.max(1, clientHeight));
  }

  /** Pixels from the left and from the top, and 1 / distance from the camera, of points (3 N). */
  project(points) {
    const { view, project } = this.matrices();
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const found = new Float64Array(points.length);
    for (let i = 0; i < points.length; i += 3) {
      const [x, y, z] = [points[i], points[i + 1], points[i + 2]];
      const ex = view[0] * x + view[4] * y + view[8] * z + view[12];
      const ey = view[1] * x + view[5] * y + view[9] * z + view[13];
      const ez = view[2] * x + view[6] * y + view[10] * z + view[14];
      const near = -1 / ez;
      found[i] = ((project[0] * ex + project[8] * ez) * near * 0.5 + 0.5) * width;
      found[i + 1] = (0.5 - (project[5] * ey + project[9] * ez) * near * 0.5) * height;
      found[i + 2] = near;
    }
    return found;
  }

  /** The place of the surface that a pixel shows; null where it shows none. */
  hit(x, y) {
    const seen = this.project(this.face.positions);
    const { faces } = this.face;
    let best = null, nearest = 0;
    for (let i = 0; i < faces.length; i += 3) {
      const a = 3 * faces[i], b = 3 * faces[i + 1], c = 3 * faces[i + 2];
      const ax = seen[a] - x, ay = seen[a + 1] - y, bx = seen[b] - x, by = seen[b + 1] - y, cx = seen[c] - x, cy = seen[c + 1] - y;
      const wa = bx * cy - by * cx, wb = cx * ay - cy * ax, wc = ax * by - ay * bx;
      if ((wa < 0 || wb < 0 || wc < 0) && (wa > 0 || wb > 0 || wc > 0)) continue;
      const area = wa + wb + wc;
      if (area === 0 || seen[a + 2] <= 0 || seen[b + 2] <= 0 || seen[c + 2] <= 0) continue;
      // 1 / distance is linear in the picture; a corner's weight on the surface is its share of that.
      const shares = [(wa / area) * seen[a + 2], (wb / area) * seen[b + 2], (wc / area) * seen[c + 2]];
      const near = shares[0] + shares[1] + shares[2];
      if (near <= nearest) continue;
      nearest = near;
      best = [[faces[i], faces[i + 1], faces[i + 2]], shares.map((share) => share / near)];
    }
    return best && placeAt(...best);
  }

  /** The place of the surface that is nearest to the mirror image of a place. */
  mirrored(place) {
    const [x, y, z, offset] = this.facts.plane;
    const point = pointOf(this.face, place), away = 2 * (dot([x, y, z], point) - offset);
    const wanted = [point[0] - away * x, point[1] - away * y, point[2] - away * z];
    const { faces, positions } = this.face;
    const corner = (vertex) => [positions[3 * vertex], positions[3 * vertex + 1], positions[3 * vertex + 2]];
    let best = null, least = Infinity;
    for (let i = 0; i < faces.length; i += 3) {
      const three = [faces[i], faces[i + 1], faces[i + 2]], points = three.map(corner);
      const weights = nearestOnTriangle(wanted, ...points);
      const there = [0, 1, 2].map((axis) => weights[0] * points[0][axis] + weights[1] * points[1][axis] + weights[2] * points[2][axis]);
      const gap = sub(there, wanted), distance = dot(gap, gap);
      if (distance < least) [best, least] = [[three, weights], distance];
    }
    return placeAt(...best);
  }

  draw() {
    this.scene.resize(1);
    if (this.scene.fresh) {
      this.scene.upload(0);
      this.scene.fresh = false;
    }
    this.scene.draw([{ number: 0, place: [0, 0, 1, 1] }], this.camera, this.extent, 0, this.edges);
    this.showPoints();
  }

  showPoints() {
    const { points, chosen } = this.app;
    const { view } = this.matrices();
    const back = [view[2], view[6], view[10]];
    this.overlay.replaceChildren(
      ...points.flatMap((point, number) => {
        const place = point[this.name];
        if (!place) return [];
        const mark = make("div", "point");
        mark.append(make("span", "", String(number + 1)));
        mark.classList.toggle("chosen", number === chosen);
        mark.classList.toggle("left", point.name.endsWith("_middle")); // next to other points
        mark.classList.toggle("behind", dot(normalOf(this.face, place), back) < -0.05);
        const [x, y] = this.project(pointOf(this.face, place));
        Object.assign(mark.style, { left: `${x}px`, top: `${y}px` });
        mark.dataset.number = String(number + 1);
        return [mark];
      })
    );
  }
}

/** The points, what is chosen, and all that is done with them. */
class Picker {
  constructor(facts, faces) {
    this.facts = facts;
    this.descriptions = new Map(facts.names);
    this.steps = [];
    this.saved = false;
    this.points = facts.names.map(([name]) => ({ name, source: this.known("source", name), target: this.known("target", name) }));
    for (const { name, source, target } of facts.start) {
      const point = this.points.find((each) => each.name === name) ?? (this.points.push({ name }), this.points.at(-1));
      Object.assign(point, { name: point.name || this.freeName(), source: asPlace(source), target: asPlace(target) });
    }
    this.chosen = 0;
    this.sides = ["source", "target"].map((name) => new Side(name, facts.sides[name], faces[name], this));
    this.connect();
    this.choose(this.next(-1));
  }

  known(side, name) {
    const vertex = this.facts.known[side][name];
    return vertex === undefined ? null : vertexPlace(vertex);
  }

  freeName() {
    let number = 1;
    while (this.points.some((point) => point.name === `point ${number}`)) number += 1;
    return `point ${number}`;
  }

  get complete() {
    return this.points.filter((point) => point.source && point.target);
  }

  /** The first point after one that lacks a place; the same if none does. */
  next(from) {
    const count = this.points.length;
    for (let step = 1; step <= count; step++) {
      const number = (from + step + count) % count;
      if (!this.points[number].source || !this.points[number].target) return number;
    }
    return Math.max(0, from);
  }

  request() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      for (const side of this.sides) side.draw();
    });
  }

  /** Both faces turn together. */
  moved(side) {
    const other = this.sides?.find((each) => each !== side);
    if (!other) return;
    for (const name of ["yaw", "pitch", "zoom", "panX", "panY"]) other.camera[name] = side.camera[name];
    this.request();
  }

  /** Change the points in a way that can be taken back. */
  change(action) {
    this.steps.push(JSON.stringify([this.points, this.chosen]));
    action();
    this.show();
  }

  undo() {
    const last = this.steps.pop();
    if (!last) return;
    [this.points, this.chosen] = JSON.parse(last);
    this.show();
  }

  choose(number) {
    this.chosen = Math.max(0, Math.min(this.points.length - 1, number));
    this.show();
  }

  pick(side, x, y) {
    const place = side.hit(x, y);
    if (!place) return this.tell("There is no surface there: click on the face.");
    this.change(() => {
      const point = this.points[this.chosen];
      point[side.name] = place;
      if (point.source && point.target) this.chosen = this.next(this.chosen);
    });
  }

  remove() {
    this.change(() => {
      const point = this.points[this.chosen];
      if (this.descriptions.has(point.name)) {
        Object.assign(point, { source: this.known("source", point.name), target: this.known("target", point.name) });
      } else {
        this.points.splice(this.chosen, 1);
        this.chosen = Math.min(this.chosen, this.points.length - 1);
      }
    });
  }

  add() {
    this.change(() => {
      this.points.push({ name: this.freeName(), source: null, target: null });
      this.chosen = this.points.length - 1;
    });
  }

  /** Place the point of the other side, on both faces. */
  mirror() {
    const point = this.points[this.chosen];
    const swapped = point.name.endsWith("_left") ? point.name.replace(/_left$/, "_right") : point.name.replace(/_right$/, "_left");
    if (this.descriptions.has(point.name) && swapped === point.name) return this.tell(`The ${words(point.name)} lies in the middle: it has no mirror image.`);
    if (!point.source && !point.target) return this.tell("Place the point first, then mirror it.");
    this.change(() => {
      const name = swapped === point.name ? `${point.name} mirrored` : swapped;
      let other = this.points.find((each) => each.name === name);
      if (!other) this.points.push((other = { name, source: null, target: null }));
      for (const side of this.sides) {
        if (point[side.name]) other[side.name] = this.known(side.name, name) ?? side.mirrored(point[side.name]);
      }
      this.chosen = other.source && other.target ? this.next(this.points.indexOf(other)) : this.points.indexOf(other);
    });
  }

  /** Fill in what the target's shape shows where nothing was picked. */
  suggest() {
    this.change(() => {
      for (const [name, vertex] of Object.entries(this.facts.suggested)) {
        const point = this.points.find((each) => each.name === name);
        if (point && !point.target) point.target = vertexPlace(vertex);
      }
      this.chosen = this.next(this.chosen);
    });
    this.tell("The shape of the mesh suggests these: look at them, and correct what is wrong.");
  }

  tell(text) {
    find("task").textContent = text;
  }

  async save() {
    const { complete, facts } = this;
    if (this.saved || this.saving || complete.length < facts.fewest) return;
    this.saving = true;
    await this.send(complete, facts).finally(() => (this.saving = false));
  }

  async send(complete, facts) {
    const body = {
      format: facts.format,
      source_vertices: facts.sides.source.vertices,
      target_vertices: facts.sides.target.vertices,
      landmarks: complete.map(({ name, source, target }) => ({ name, source: asValue(source), target: asValue(target) })),
    };
    const answer = await fetch("api/landmarks", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(body),
    }).catch(() => null);
    if (!answer) return report("the command does not answer: it has ended; start it again, this page keeps what was picked");
    const told = await answer.json().catch(() => ({}));
    if (!answer.ok) return report(`not saved: ${told.error ?? answer.status}`);
    this.saved = true;
    find("message").hidden = true;
    this.show();
    this.tell(`Saved: ${told.saved} pairs in ${told.file}. The command goes on; this page can be closed.`);
  }

  show() {
    const { points, chosen, complete, facts } = this;
    find("list").replaceChildren(
      ...points.map((point, number) => {
        const row = make("li");
        const button = make("button");
        button.type = "button";
        const state = point.source && point.target ? "done" : point.source || point.target ? "1 of 2" : "";
        button.append(make("span", "number", String(number + 1)), make("span", "place", words(point.name)), make("span", "state", state));
        button.setAttribute("aria-current", String(number === chosen));
        button.addEventListener("click", () => this.choose(number));
        row.append(button);
        return row;
      })
    );
    find("list").children[chosen]?.scrollIntoView({ block: "nearest" });
    const point = points[chosen];
    const wanted = !point ? [] : ["source", "target"].filter((side) => !point[side]);
    for (const side of this.sides) side.root.classList.toggle("wanted", wanted.includes(side.name));
    if (point) {
      const where = wanted.length === 2 ? "on both faces" : wanted[0] === "source" ? "on the animation's face" : wanted[0] ? "on your mesh" : "";
      const what = this.descriptions.get(point.name);
      const task = find("task");
      task.replaceChildren(make("b", "", `${chosen + 1}. ${words(point.name)}`), what ? `: ${what}. ` : ". ");
      task.append(where ? `Click it ${where}.` : "Both are placed; click again to move one.");
    }
    const missing = facts.fewest - complete.length;
    find("save").disabled = this.saved || missing > 0;
    find("save").textContent = this.saved ? "Saved" : missing > 0 ? `Save (${missing} more)` : `Save ${complete.length}`;
    find("undo").disabled = !this.steps.length;
    this.request();
  }

  connect() {
    const click = (id, action) => find(id).addEventListener("click", () => action.call(this));
    click("undo", this.undo);
    click("mirror", this.mirror);
    click("remove", this.remove);
    click("add", this.add);
    click("suggest", this.suggest);
    click("save", this.save);
    find("suggest").hidden = !Object.keys(this.facts.suggested).length;
    addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    if (document.querySelector("dialog[open]")) return;
    const letter = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (event.ctrlKey || event.metaKey) {
      const action = { s: () => this.save(), z: () => this.undo() }[letter];
      if (!action || event.altKey) return;
      event.preventDefault();
      return void action();
    }
    if (event.altKey) return;
    const { camera } = this.sides[0];
    const actions = {
      u: () => this.undo(),
      m: () => this.mirror(),
      f: () => this.add(),
      g: () => find("suggest").hidden || this.suggest(),
      n: () => this.choose((this.chosen + 1) % this.points.length),
      p: () => this.choose((this.chosen + this.points.length - 1) % this.points.length),
      Delete: () => this.remove(),
      Backspace: () => this.remove(),
      "+": () => camera.magnify(1.15),
      "-": () => camera.magnify(1 / 1.15),
      a: () => camera.turn(-0.1, 0),
      d: () => camera.turn(0.1, 0),
      w: () => camera.turn(0, 0.1),
      s: () => camera.turn(0, -0.1),
      r: () => camera.reset(),
      "?": () => find("keys").showModal(),
    };
    if (!actions[letter]) return;
    event.preventDefault();
    actions[letter]();
  }
}

/** Corners of triangles less those of some runs of them. */
function withoutParts(faces, runs) {
  const gone = new Uint8Array(faces.length / 3);
  for (const [first, count] of runs) gone.fill(1, first, first + count);
  return faces.filter((_, corner) => !gone[Math.floor(corner / 3)]);
}

async function readSide(side) {
  const { template: positions, faces, colours } = await readMesh(side);
  return {
    positions,
    normals: new Float32Array(positions.length),
    faces,
    colours,
    distances: null,
    centre: side.centre,
  };
}

async function start() {
  const facts = JSON.parse(find("facts").textContent);
  connectDialogs();
  const [source, target] = await Promise.all([readSide(facts.sides.source), readSide(facts.sides.target)]);
  const picker = new Picker(facts, { source, target });
  /** For scripts: the points, and where places are seen in pixels of the page. */
  window.facediffPicking = {
    errors,
    get points() { return picker.points; },
    get chosen() { return picker.chosen; },
    get saved() { return picker.saved; },
    seen(name, point) {
      const side = picker.sides.find((each) => each.name === name);
      const { left, top } = side.canvas.getBoundingClientRect();
      const [x, y] = side.project(point);
      return [left + x, top + y];
    },
    positions: (name) => [...picker.sides.find((each) => each.name === name).face.positions],
    pointOf: (name, place) => pointOf(picker.sides.find((each) => each.name === name).face, place),
  };
  document.body.classList.add("ready");
}

start().catch(report);
