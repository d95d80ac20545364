"use strict";
// The page's data: base64 to bytes, bytes to arrays, and motions that are unpacked in pieces when they are needed.

/** Bytes of a blob; the text of the element stays, so that a chunk can be unpacked again. */
function encodedBytes(number) {
  const text = atob(document.getElementById(`blob-${number}`).textContent);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

/** A blob, inflated. */
async function readBlob(number) {
  const stream = new Blob([encodedBytes(number)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

/** A mesh at rest: positions (3 V, mm), triangles (3 F, outward), and colours (3 V) or null, by the numbers of its blobs. */
async function readMesh({ template, faces, colours }) {
  const [positions, triangles, tints] = await Promise.all([template, faces, colours].map((number) => number === null ? null : readBlob(number)));
  return { template: new Float32Array(positions), faces: new Uint32Array(triangles), colours: tints && new Uint8Array(tints) };
}

/** Let the browser draw and handle events. */
const breathe = () => new Promise((resolve) => setTimeout(resolve, 0));

const SLICE_MS = 5;

/**
 * Undo the packing: planes of low and high bytes in the order axis, vertex, frame, to steps in the order frame, vertex,
 * axis. Works in slices, so that a large mesh does not hold up the picture.
 */
async function unfold(packed, vertices, frames) {
  const bytes = new Uint8Array(packed);
  const count = 3 * vertices;
  const half = count * frames;
  if (bytes.length !== 2 * half) throw new Error(`a chunk has ${bytes.length} bytes instead of ${2 * half}`);
  const steps = new Int16Array(half);
  let started = performance.now();
  for (let series = 0; series < count; series++) {
    const from = series * frames;
    let to = 3 * (series % vertices) + Math.floor(series / vertices);
    let sum = 0;
    for (let i = from; i < from + frames; i++, to += count) {
      const folded = bytes[i] | (bytes[half + i] << 8);
      sum += (folded >>> 1) ^ -(folded & 1);
      steps[to] = sum; // modulo 2 to the 16th, as it was packed
    }
    if ((series & 4095) === 4095 && performance.now() - started > SLICE_MS) {
      await breathe();
      started = performance.now();
    }
  }
  return steps;
}

/** One animation's motion: offsets from the template by frame, unpacked chunk by chunk; a few chunks are kept. */
class Motion {
  constructor(facts, animation, onError) {
    this.numbers = animation.chunks;
    this.vertices = animation.vertices;
    this.frames = facts.frames;
    this.chunkFrames = facts.chunkFrames;
    this.onError = onError;
    this.ready = new Map(); // chunk → steps
    this.pending = new Map(); // chunk → promise
    const bytes = 6 * this.vertices * this.chunkFrames;
    this.kept = Math.max(3, Math.floor(Motion.MEMORY / bytes));
  }

  chunkOf(frame) {
    return Math.floor(frame / this.chunkFrames);
  }

  /** Steps of a frame (3 V), or null while they are being unpacked; asks for the next chunk as well. */
  at(frame) {
    const chunk = this.chunkOf(frame);
    this.load(chunk);
    if (this.numbers.length > 1) this.load((chunk + 1) % this.numbers.length);
    const steps = this.ready.get(chunk);
    if (!steps) return null;
    const size = 3 * this.vertices;
    const start = (frame % this.chunkFrames) * size;
    return steps.subarray(start, start + size);
  }

  load(chunk) {
    if (this.ready.has(chunk)) {
      const steps = this.ready.get(chunk); // the most recently used come last
      this.ready.delete(chunk);
      this.ready.set(chunk, steps);
      return Promise.resolve();
    }
    if (!this.pending.has(chunk)) {
      const work = this.unpack(chunk).catch(this.onError).finally(() => this.pending.delete(chunk));
      this.pending.set(chunk, work);
    }
    return this.pending.get(chunk);
  }

  async unpack(chunk) {
    const frames = Math.min(this.chunkFrames, this.frames - chunk * this.chunkFrames);
    const steps = await unfold(await readBlob(this.numbers[chunk]), this.vertices, frames);
    this.ready.set(chunk, steps);
    for (const oldest of this.ready.keys()) {
      if (this.ready.size <= this.kept) break;
      this.ready.delete(oldest);
    }
  }
}

/** Bytes of unpacked motion that are kept for one animation. */
Motion.MEMORY = 24e6;
