// A take as glTF 2.0 in one binary file: a mesh with as few morph targets as give back every frame of the page.

const GLB_TOLERANCE = 0.1; // mm, by which a vertex may be off the page's own positions, which are rounded to half of it
const GLB_MEMORY = 600e6; // bytes of offsets that are taken apart at once

/**
 * Shapes whose weighted sums are the frames: again and again the frame that is worst off becomes a shape, and what it
 * explains is taken from all frames (Gram-Schmidt).
 *
 * Args: offsets from the rest face, frame after frame (T · 3 V); the number of frames; the largest distance of a vertex.
 * Returns: pairs of a shape (3 V) and its weights (T), or null if they are too many to pay; the offsets are used up.
 */
async function shapesOf(offsets, frames, tolerance) {
  const size = offsets.length / frames;
  const row = (frame) => offsets.subarray(frame * size, (frame + 1) * size);
  const found = [];
  while (2 * found.length < frames) { // two halves each: beyond that, frames themselves are fewer
    let worst = -1, furthest = tolerance ** 2;
    for (let frame = 0; frame < frames; frame++) {
      const left = row(frame);
      for (let i = 0; i < size; i += 3) {
        const squared = left[i] * left[i] + left[i + 1] * left[i + 1] + left[i + 2] * left[i + 2];
        if (squared > furthest) [worst, furthest] = [frame, squared];
      }
    }
    if (worst < 0) return found;
    const shape = row(worst).slice(), weights = new Float32Array(frames);
    const length = shape.reduce((sum, value) => sum + value * value, 0);
    for (let frame = 0; frame < frames; frame++) {
      const left = row(frame);
      let along = 0;
      for (let i = 0; i < size; i++) along += left[i] * shape[i];
      const weight = (weights[frame] = along / length);
      for (let i = 0; i < size; i++) left[i] -= weight * shape[i];
    }
    found.push([shape, weights]);
    await breathe();
  }
  return null;
}

/** Shapes with weights from 0 to 1: programs that clamp weights would break negative ones, so each half gets its own. */
function halvesOf(shapes) {
  const found = [];
  for (const [shape, weights] of shapes) {
    for (const sign of [1, -1]) {
      const peak = weights.reduce((most, weight) => Math.max(most, sign * weight), 0);
      if (peak > 0) found.push([shape.map((value) => sign * peak * value), weights.map((weight) => Math.max(0, (sign * weight) / peak))]);
    }
  }
  return found;
}

/** Weights (T) of a shape that is one of the frames. */
const oneOf = (frames, frame) => Float32Array.from({ length: frames }, (_, each) => Number(each === frame));

/** Shapes with weights that give back every frame. Args: what makes the offsets in mm (T · 3 V); frames; numbers in one. */
async function compressed(offsetsOf, frames, size) {
  if (4 * size * frames > GLB_MEMORY) {
    throw new Error("too much motion for a .glb made in a page: download the .npz, and run facediff export");
  }
  let offsets = await offsetsOf();
  const few = await shapesOf(offsets, frames, GLB_TOLERANCE);
  let shapes = few && halvesOf(few);
  if (!few) { // a shape for every frame is exact, and fewer
    offsets = await offsetsOf();
    shapes = Array.from({ length: frames }, (_, frame) => [offsets.slice(frame * size, (frame + 1) * size), oneOf(frames, frame)]);
  }
  // A face that never moves still needs something to animate.
  if (!shapes.length) shapes.push([new Float32Array(size), new Float32Array(frames)]);
  return { shapes, names: shapes.map((_, i) => `shape_${String(i).padStart(4, "0")}`) };
}

/**
 * The parts of a .glb. Args: the face, whose template is that of all weights 0; shapes (3 V, in mm) with their weights
 * (T), and their names; frames a second; the name; facts that are written with it.
 */
async function glb(face, { shapes, names }, frameRate, name, extras) {
  const size = face.template.length, frames = shapes[0][1].length;
  const times = Array.from({ length: frames }, (_, frame) => frame / frameRate);
  const views = [], accessors = [], parts = [];
  let length = 0;
  const add = (array, type, bounds, target) => {
    const columns = { VEC4: 4, VEC3: 3 }[type] ?? 1;
    const accessor = {
      bufferView: views.length,
      componentType: array instanceof Uint32Array ? 5125 : 5126,
      count: array.length / columns,
      type,
    };
    if (bounds) {
      accessor.min = new Array(columns).fill(Infinity);
      accessor.max = new Array(columns).fill(-Infinity);
      array.forEach((value, i) => {
        accessor.min[i % columns] = Math.min(accessor.min[i % columns], value);
        accessor.max[i % columns] = Math.max(accessor.max[i % columns], value);
      });
    }
    views.push({ buffer: 0, byteOffset: length, byteLength: array.byteLength, target });
    parts.push(array);
    length += array.byteLength; // all parts are of four bytes each, so that all are aligned
    return accessors.push(accessor) - 1;
  };
  const metres = (values) => Float32Array.from(values, (value) => value / 1000);
  const normals = new Float32Array(size), turned = new Float32Array(size);
  orient(normals, face.template, face.faces);
  const attributes = { POSITION: add(metres(face.template), "VEC3", true, 34962), NORMAL: add(normals, "VEC3", false, 34962) };
  if (face.colours) {
    const linear = (value) => (value <= 10.31475 ? value / 3294.6 : ((value / 255 + 0.055) / 1.055) ** 2.4);
    attributes.COLOR_0 = add(Float32Array.from(face.colours, linear), "VEC3", false, 34962);
  }
  const indices = add(face.faces, "SCALAR", false, 34963);
  const targets = shapes.map(([shape]) => {
    orient(turned, face.template.map((value, i) => value + shape[i]), face.faces);
    const change = turned.map((value, i) => value - normals[i]);
    return { POSITION: add(metres(shape), "VEC3", true, 34962), NORMAL: add(change, "VEC3", false, 34962) };
  });
  const weights = new Float32Array(frames * shapes.length);
  shapes.forEach(([, row], i) => row.forEach((weight, frame) => (weights[frame * shapes.length + i] = weight)));
  const material = { name: "face", doubleSided: true, pbrMetallicRoughness: { metallicFactor: 0, roughnessFactor: 0.7 } };
  if (!face.colours) material.pbrMetallicRoughness.baseColorFactor = [0.6, 0.6, 0.6, 1];
  const document = {
    asset: { version: "2.0", generator: "facediff" },
    scene: 0,
    scenes: [{ nodes: [0] }],
    nodes: [{ name, mesh: 0, extras }],
    meshes: [{
      name: "face",
      primitives: [{ attributes, indices, material: 0, targets }],
      weights: shapes.map(() => 0),
      extras: { targetNames: names },
    }],
    materials: [material],
    animations: [{
      name,
      samplers: [{ input: add(Float32Array.from(times), "SCALAR", true), output: add(weights, "SCALAR"), interpolation: "LINEAR" }],
      channels: [{ sampler: 0, target: { node: 0, path: "weights" } }],
    }],
    accessors,
    bufferViews: views,
    buffers: [{ byteLength: length }],
  };
  const text = new TextEncoder().encode(JSON.stringify(document));
  const padding = new Uint8Array(-text.length & 3).fill(32);
  const chunk = text.length + padding.length;
  const head = Uint32Array.of(0x46546c67, 2, 28 + chunk + length, chunk, 0x4e4f534a);
  return [head, text, padding, Uint32Array.of(length, 0x004e4942), ...parts];
}
