// One camera for all faces: they turn together, so that what is compared is seen from one side.

const FIELD_OF_VIEW = (18 * Math.PI) / 180; // a portrait lens: the nose does not swell
const STEEPEST = (85 * Math.PI) / 180;
const START = { yaw: 0, pitch: 0, zoom: 1, panX: 0, panY: 0 };

class Camera {
  constructor(element, onMove) {
    this.onMove = onMove;
    this.pointers = new Map();
    Object.assign(this, START);
    element.addEventListener("pointerdown", (event) => this.press(event, element));
    element.addEventListener("pointermove", (event) => this.drag(event, element));
    for (const name of ["pointerup", "pointercancel"]) {
      element.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    element.addEventListener("wheel", (event) => this.roll(event), { passive: false });
    element.addEventListener("dblclick", () => this.reset());
    element.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  reset() {
    Object.assign(this, START);
    this.onMove();
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.max(-STEEPEST, Math.min(STEEPEST, this.pitch + pitch));
    this.onMove();
  }

  magnify(factor) {
    this.zoom = Math.max(0.3, Math.min(20, this.zoom * factor));
    this.onMove();
  }

  /** Shift by shares of the picture's height. */
  pan(x, y) {
    this.panX += x / this.zoom;
    this.panY += y / this.zoom;
    this.onMove();
  }

  press(event, element) {
    element.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  }

  drag(event, element) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    const now = { x: event.clientX, y: event.clientY };
    const x = now.x - last.x, y = now.y - last.y;
    const size = Math.min(element.clientHeight, element.clientWidth) || 1;
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const apart = (point) => Math.hypot(point.x - other.x, point.y - other.y) || 1;
      this.pan(x / 2 / size, y / 2 / size);
      this.magnify(apart(now) / apart(last));
    } else if (event.shiftKey || event.buttons & 6) {
      this.pan(x / size, y / size);
    } else {
      this.turn((-3 * x) / size, (3 * y) / size);
    }
    this.pointers.set(event.pointerId, now);
  }

  roll(event) {
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 : 1;
    this.magnify(Math.exp(-0.0015 * event.deltaY * lines));
  }

  /**
   * The matrices of one panel, column by column: `view` turns the face (mm) before the camera, `project` makes the
   * picture.
   *
   * Args: centre and half extents of the face, width / height of the panel, and the shares of its height above and below
   * that the face leaves free.
   */
  matrices(centre, extent, panelAspect, [above, below] = [0, 0]) {
    const tallness = 1 - above - below;
    const aspect = panelAspect / tallness;
    const slope = Math.tan(FIELD_OF_VIEW / 2);
    const [halfWidth, halfHeight, halfDepth] = extent;
    const distance = 1.08 * Math.max(halfHeight, Math.max(halfWidth, 0.75 * halfDepth) / aspect) / slope + halfDepth;
    const reach = Math.hypot(halfWidth, halfHeight, halfDepth) * 4;
    const cy = Math.cos(this.yaw), sy = Math.sin(this.yaw), cp = Math.cos(this.pitch), sp = Math.sin(this.pitch);
    // Camera axes in the face's: to the right, up, and from the face to the camera.
    const right = [cy, 0, -sy];
    const up = [-sp * sy, cp, -sp * cy];
    const back = [cp * sy, sp, cp * cy];
    const dot = (axis) => axis[0] * centre[0] + axis[1] * centre[1] + axis[2] * centre[2];
    const tall = 2 * distance * slope;
    const near = Math.max(distance / 100, distance - reach), far = distance + reach;
    return {
      view: new Float32Array([
        right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
        this.panX * tall - dot(right), -this.panY * tall - dot(up), -distance - dot(back), 1,
      ]),
      project: new Float32Array([
        this.zoom / slope / aspect, 0, 0, 0, 0, (tallness * this.zoom) / slope, 0, 0,
        0, above - below, (near + far) / (near - far), -1, 0, 0, (2 * near * far) / (near - far), 0,
      ]),
    };
  }
}
