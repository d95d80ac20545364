// What changed keys do to the picture without the model: how large the motion is, shapes, brows, lids, and the head's turn.

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
   * rotation about the origin and a shift in mm), or null; the direction as it was; displacements (3 V, mm) by name, which
   * pages of built-in faces have; curves (T) of what acting and blinking added.
   */
  constructor(facts, animation, weights, head, before, fields, acted) {
    Object.assign(this, { facts, animation, weights, head, before, fields, acted });
  }

  /** Whether the page can show what keys of a channel do. */
  shows(name) {
    const { preview } = this.facts.direction.channels[name] ?? this.facts.direction.channels[name.split(".")[0]];
    return preview === "always" || (preview === "posed" && this.fields !== null);
  }

  /** What keys, acting and blinking together give a channel in a frame, as facediff animate adds them up. */
  total(direction, name, frame) {
    const { frameRate, direction: { stepSeconds } } = this.facts;
    const value = (channel) => direction.value(channel, frame / frameRate, stepSeconds);
    const [least, most] = direction.channel(name).range;
    const byRule = (rule) => this.acted && !direction.keys.turned.includes(rule);
    let sum = direction.of(name).length ? value(name) : 0;
    if (byRule("acting") && this.acted.acting[name]) {
      const strength = value("acting");
      sum = Math.max(least, Math.min(most, sum + this.acted.acting[name][frame] * (name === "lids" ? Number(strength > 0) : strength)));
    }
    return name === "lids" && byRule("blinks") && this.acted.blinks ? Math.max(sum, this.acted.blinks[frame]) : sum;
  }

  /** The frames' values of a channel as few keys: straight lines between them are within a tolerance of each frame. */
  reduced(direction, name, tolerance) {
    const { frames, frameRate } = this.facts;
    const values = Array.from({ length: frames }, (_, frame) => this.total(direction, name, frame));
    const kept = new Set([0, frames - 1]), spans = [[0, frames - 1]];
    while (spans.length) { // Ramer, Douglas and Peucker, with distances along the values
      const [from, to] = spans.pop();
      let worst = tolerance, place = -1;
      for (let frame = from + 1; frame < to; frame++) {
        const off = Math.abs(values[from] + ((values[to] - values[from]) * (frame - from)) / (to - from) - values[frame]);
        if (off > worst) [worst, place] = [off, frame];
      }
      if (place < 0) continue;
      kept.add(place);
      spans.push([from, place], [place, to]);
    }
    return [...kept].sort((a, b) => a - b).map((frame) => (
      { time: frame / frameRate, channel: name, value: Number(values[frame].toFixed(4)), interpolation: "linear" }));
  }

  /** Bring a frame's positions (3 V) from the old direction to the new one. */
  apply(positions, template, frame, now) {
    const { before } = this;
    if (before.keys === now.keys) return;
    const time = frame / this.facts.frameRate;
    const value = (direction, name) => direction.value(name, time, this.facts.direction.stepSeconds);
    const turn = (direction) => HEAD.map((name) => (this.total(direction, name, frame) * Math.PI) / 180);
    const moved = this.head ? [...this.head.subarray(6 * frame, 6 * frame + 6)] : [0, 0, 0, 0, 0, 0];
    // What sway adds stays: rotations of the head are sums of rotation vectors.
    const was = turn(before), is = turn(now).map((angle, axis) => moved[axis] + angle - was[axis]);
    const old = rotationOf(...moved.slice(0, 3)), wanted = rotationOf(...is);
    const { neck } = this.animation;
    const back = [0, 1, 2].map((row) => [0, 1, 2].map((column) => old[3 * column + row])).flat(); // the inverse
    if (moved.some(Boolean)) move(positions, back, moved.slice(3), [0, 0, 0]);
    if (this.fields) {
      this.moveLids(positions, template, this.total(before, "lids", frame), true);
      this.pose(positions, before, frame, -1);
    }
    this.scale(positions, template, value, now);
    if (this.fields) {
      this.pose(positions, now, frame, 1);
      this.moveLids(positions, template, this.total(now, "lids", frame), false);
    }
    // The neck stays where the old motion had it.
    const place = turned(old, neck).map((each, axis) => each + moved[3 + axis]);
    if (is.some(Boolean) || moved.some(Boolean)) move(positions, wanted, neck, place);
  }

  /** Add shapes and brows, or take them away (sign −1). */
  pose(positions, direction, frame, sign) {
    const add = (field, amount) => {
      if (amount) for (let i = 0; i < positions.length; i++) positions[i] += amount * field[i];
    };
    for (const name of direction.channels) {
      if (name.startsWith("shape.")) add(this.fields.shapes[name.slice(6)], sign * this.total(direction, name, frame));
    }
    const brows = this.total(direction, "brows", frame);
    add(brows > 0 ? this.fields.browsUp : this.fields.browsDown, sign * Math.abs(brows));
  }

  /** Shut the lids: their own closing a becomes a + b (1 − a); or back from there, which a shut eye does not say. */
  moveLids(positions, template, b, back) {
    if (!b) return;
    const { closing } = this.fields, { widened } = this.animation.fields;
    for (let i = 0; i < positions.length; i += 3) {
      const size = closing[i] ** 2 + closing[i + 1] ** 2 + closing[i + 2] ** 2;
      if (!size) continue;
      let along = 0;
      for (let axis = i; axis < i + 3; axis++) along += (positions[axis] - template[axis]) * closing[axis];
      const a = along / size; // as far as it is shut; what counts is limited, and beyond the limits the way is the same
      let by = b * (1 - Math.max(widened, Math.min(1, a)));
      if (back && a < widened + (1 - widened) * b) by = -(1 - widened) * b;
      else if (back) by = a > 1 ? 0 : (b < 0.999 ? (a - b) / (1 - b) : 0) - a;
      for (let axis = i; axis < i + 3; axis++) positions[axis] += by * closing[axis];
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
