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

/** The preview of one animation, from the direction that it was made with to the one that is edited. */
class Preview {
  /** Args: the page's facts; the animation's; weights of its regions (V, 0 to 1) by name; the direction as it was. */
  constructor(facts, animation, weights, before) {
    Object.assign(this, { facts, animation, weights, before });
  }

  /** Bring a frame's positions (3 V) from the old direction to the new one; both are given as a time in s has them. */
  apply(positions, template, time, now) {
    const { before } = this;
    if (before.keys === now.keys) return;
    const value = (direction, name) => direction.value(name, time, this.facts.direction.stepSeconds);
    const turn = (direction) => HEAD.map((name) => (direction.of(name).length ? value(direction, name) : 0));
    const was = turn(before), is = turn(now);
    if (was.some(Boolean)) this.rotate(positions, was, true);
    this.scale(positions, template, (direction, name) => value(direction, name), now);
    if (is.some(Boolean)) this.rotate(positions, is, false);
  }

  /** Turn the head about its neck by pitch, yaw and roll in degrees, or back. */
  rotate(positions, degrees, back) {
    const [x, y, z] = degrees.map((each) => (each * Math.PI) / 180);
    const m = back ? rotationOf(-x, -y, -z) : rotationOf(x, y, z);
    const [px, py, pz] = this.animation.neck;
    for (let i = 0; i < positions.length; i += 3) {
      const a = positions[i] - px, b = positions[i + 1] - py, c = positions[i + 2] - pz;
      positions[i] = m[0] * a + m[1] * b + m[2] * c + px;
      positions[i + 1] = m[3] * a + m[4] * b + m[5] * c + py;
      positions[i + 2] = m[6] * a + m[7] * b + m[8] * c + pz;
    }
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
