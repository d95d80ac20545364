// What changed keys do to the picture without the model: how large the motion is, and how the head is turned.

/** Matrix (3 × 3, row by row) of a rotation vector in radians, by Rodrigues' formula. */
function rotationOf(x, y, z) {
  const angle = Math.hypot(x, y, z);
  const a = angle > 1e-9 ? Math.sin(angle) / angle : 1, b = angle > 1e-9 ? (1 - Math.cos(angle)) / angle ** 2 : 0.5;
  const c = Math.cos(angle);
  return [
    c + b * x * x, b * x * y - a * z, b * x * z + a * y,
    b * x * y + a * z, c + b * y * y, b * y * z - a * x,
    b * x * z - a * y, b * y * z + a * x, c + b * z * z,
  ];
}

const HEAD = ["head.pitch", "head.yaw", "head.roll"];
const LEAST_FACTOR = 0.05; // a motion that was scaled to less cannot be scaled back

/** A point (3) turned by a matrix. */
const turned = (m, [x, y, z]) => [0, 3, 6].map((row) => m[row] * x + m[row + 1] * y + m[row + 2] * z);

/** Turn positions (3 V) about a point, which then goes to a place. */
function move(positions, m, [x, y, z], [toX, toY, toZ]) {
  for (let i = 0; i < positions.length; i += 3) {
    const a = positions[i] - x, b = positions[i + 1] - y, c = positions[i + 2] - z;
    positions[i] = m[0] * a + m[1] * b + m[2] * c + toX;
    positions[i + 1] = m[3] * a + m[4] * b + m[5] * c + toY;
    positions[i + 2] = m[6] * a + m[7] * b + m[8] * c + toZ;
  }
}

/** The preview of one animation, from the direction that it was made with to the one that is edited. */
class Preview {
  /**
   * Args: the page's facts; the animation's; weights of its regions (V, 0 to 1) by name; the motion of its head (T · 6: a
   * rotation about the origin and a shift in mm), or null; the direction as it was.
   */
  constructor(facts, animation, weights, head, before) {
    Object.assign(this, { facts, animation, weights, head, before });
  }

  /** Bring a frame's positions (3 V) from the old direction to the new one. */
  apply(positions, template, frame, now) {
    const { before } = this;
    if (before.keys === now.keys) return;
    const time = frame / this.facts.frameRate;
    const value = (direction, name) => direction.value(name, time, this.facts.direction.stepSeconds);
    const turn = (direction) => HEAD.map((name) => (direction.of(name).length ? (value(direction, name) * Math.PI) / 180 : 0));
    const moved = this.head ? [...this.head.subarray(6 * frame, 6 * frame + 6)] : [0, 0, 0, 0, 0, 0];
    // What acting and sway add to the keys stays: rotations of the head are sums of rotation vectors.
    const was = turn(before), is = turn(now).map((angle, axis) => moved[axis] + angle - was[axis]);
    const old = rotationOf(...moved.slice(0, 3)), wanted = rotationOf(...is);
    const { neck } = this.animation;
    const back = [0, 1, 2].map((row) => [0, 1, 2].map((column) => old[3 * column + row])).flat(); // the inverse
    if (moved.some(Boolean)) move(positions, back, moved.slice(3), [0, 0, 0]);
    this.scale(positions, template, value, now);
    // The neck stays where the old motion had it.
    const place = turned(old, neck).map((each, axis) => each + moved[3 + axis]);
    if (is.some(Boolean) || moved.some(Boolean)) move(positions, wanted, neck, place);
  }

  /** Scale how far each vertex is from the neutral face by the new factor over the old one. */
  scale(positions, template, value, now) {
    const factors = (direction) => {
      const names = direction.channels.filter((name) => name.split(".")[0] === "expressiveness");
      return Object.fromEntries(names.map((name) => [name.split(".").slice(1).join("."), value(direction, name)]));
    };
    const old = this.field(factors(this.before)), wanted = this.field(factors(now));
    for (let v = 0, i = 0; i < positions.length; v++, i += 3) {
      const ratio = wanted(v) / Math.max(LEAST_FACTOR, old(v));
      if (ratio === 1) continue;
      for (let axis = i; axis < i + 3; axis++) positions[axis] = template[axis] + ratio * (positions[axis] - template[axis]);
    }
  }

  /** The factor of a vertex from those by region; the empty name is that of all vertices without another one. */
  field(factors) {
    const rest = factors[""] ?? 1;
    const regions = Object.entries(factors).filter(([name]) => this.weights[name]);
    return (vertex) => {
      let total = 0, sum = 0;
      for (const [name, factor] of regions) {
        const weight = this.weights[name][vertex];
        total += weight;
        sum += weight * factor;
      }
      return sum / Math.max(1, total) + Math.max(0, 1 - total) * rest; // a partition of unity
    };
  }
}
