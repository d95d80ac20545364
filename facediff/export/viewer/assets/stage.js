// One face that is given frames one by one, as they are computed or as they arrive: what live pages draw with.

/** The middle and the half extents (x, y, z) of the vertices (3 V) that triangles use. */
function boundsOf(positions, faces) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const vertex of faces) {
    for (let axis = 0; axis < 3; axis++) {
      const value = positions[3 * vertex + axis];
      if (value < low[axis]) low[axis] = value;
      if (value > high[axis]) high[axis] = value;
    }
  }
  return { centre: low.map((value, axis) => (value + high[axis]) / 2), extent: low.map((value, axis) => (high[axis] - value) / 2) };
}

/** The face in its place on the page; it draws when something has changed, and never more often than the screen. */
class Stage {
  /**
   * Args: the canvas; the element that a pointer turns the face on; the mesh at rest: `template` (3 V, mm, Float32Array),
   * `faces` (3 F, Uint32Array, outward), `colours` (3 V, Uint8Array) or null; frames a second.
   */
  constructor(canvas, element, { template, faces, colours = null }, frameRate) {
    const { centre, extent } = boundsOf(template, faces);
    const positions = template.slice();
    this.face = { template, positions, normals: new Float32Array(template.length), faces, colours, distances: null, centre };
    this.extent = extent;
    this.edges = false;
    this.shown = 0; // frames that came onto the screen
    this.scene = new Scene(canvas, [this.face], null);
    this.camera = new Camera(element, () => this.stir());
    this.pace = new Pace(frameRate);
    this.fresh = true; // positions that are not on the graphics card yet
    this.performing = false;
    this.lean = [0, 0]; // how far the head is turned and tilted
    new ResizeObserver(() => this.stir()).observe(canvas);
    this.tick();
  }

  /** The next frame: offsets (3 V, mm) from the face at rest, or null for the face at rest itself. */
  push(offsets) {
    const { positions, template } = this.face;
    if (!offsets) positions.set(template);
    else for (let i = 0; i < positions.length; i++) positions[i] = template[i] + offsets[i];
    this.fresh = true;
  }

  /** Another face of the same mesh, with its colours. */
  wear(template, colours) {
    this.face.template = template;
    if (colours) this.face.colours = colours;
    this.scene.wear(0);
    const { centre, extent } = boundsOf(template, this.face.faces);
    this.face.centre = centre;
    this.extent = extent;
    this.push(null);
    this.stir();
  }

  /** Whether frames follow each other now; a still face is drawn sharper. */
  perform(on) {
    if (on && !this.performing) this.pace.start();
    this.performing = on;
    this.stir();
  }

  /** Turn the head a little, as people do who speak. Args: seconds since they began; null for a head at rest. */
  sway(time) {
    const at = (...rates) => rates.reduce((sum, rate, n) => sum + Math.sin(2 * Math.PI * rate * (time ?? 0) + 2 * n) / (n + 1), 0);
    const share = time === null ? 0 : 0.02 * Math.min(1, time); // radians
    this.lean = [share * at(0.13, 0.31, 0.57), 0.7 * share * at(0.19, 0.43, 0.71)];
    this.dirty = true;
  }

  /** Show the edges of the triangles, or not. */
  setEdges(on) {
    this.edges = on;
    this.stir();
  }

  /** Draw again. */
  stir() {
    this.dirty = true;
    this.movedAt = performance.now();
  }

  tick() {
    requestAnimationFrame(() => this.tick());
    const now = performance.now();
    if (this.performing) this.pace.beat(now);
    const still = !this.performing && !(now - this.movedAt < STILL_MS);
    if (still !== this.still) this.dirty = true; // in another sharpness
    this.still = still;
    if (this.scene.fresh) this.fresh = true;
    if (!this.fresh && !this.dirty) return;
    if (this.fresh) {
      orient(this.face.normals, this.face.positions, this.face.faces);
      this.scene.upload(0);
      this.scene.fresh = false;
      this.shown += 1;
    }
    this.scene.resize(still ? this.scene.finest : this.performing ? this.pace.sharpness : 1);
    const { camera } = this, { yaw, pitch } = camera;
    Object.assign(camera, { yaw: yaw + this.lean[0], pitch: pitch + this.lean[1] }); // as if the head turned
    this.scene.draw([{ number: 0, place: [0, 0, 1, 1] }], camera, this.extent, 0, this.edges);
    Object.assign(camera, { yaw, pitch });
    this.fresh = this.dirty = false;
  }
}
