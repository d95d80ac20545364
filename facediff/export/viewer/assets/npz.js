// Reads NumPy's archives. They come from elsewhere: sizes are bounded, and nothing in them is believed unchecked.

/** Most bytes that the arrays of an archive may take. */
const MOST_ARRAY_BYTES = 1e9;

const KINDS = {
  "<f4": Float32Array, "<f8": Float64Array, "|u1": Uint8Array, "|i1": Int8Array, "|b1": Uint8Array,
  "<u2": Uint16Array, "<i2": Int16Array, "<u4": Uint32Array, "<i4": Int32Array, "<u8": BigUint64Array, "<i8": BigInt64Array,
};

/** Inflate bytes to exactly so many. */
async function inflate(bytes, size, name) {
  const made = new Uint8Array(size);
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw")).getReader();
  let at = 0;
  for (;;) {
    const { done, value } = await reader.read().catch(() => {
      throw new Error(`${name}: is damaged; copy or export the model again`);
    });
    if (done) break;
    if (at + value.length > size) {
      await reader.cancel();
      throw new Error(`${name}: holds more than it says; export the model again`);
    }
    made.set(value, at);
    at += value.length;
  }
  if (at !== size) throw new Error(`${name}: is cut short; export the model again`);
  return made;
}

/** The arrays of a .npz archive by name, each { data, shape }. Args: its bytes, and what messages call it. */
async function readArrays(buffer, name) {
  const view = new DataView(buffer), bytes = new Uint8Array(buffer);
  const damaged = () => new Error(`${name}: is no archive of arrays, or is damaged; export the model again`);
  try {
    let end = buffer.byteLength - 22;
    while (end >= 0 && view.getUint32(end, true) !== 0x06054b50) end -= 1;
    if (end < 0) throw damaged();
    const count = view.getUint16(end + 10, true);
    let at = view.getUint32(end + 16, true), total = 0;
    const found = {};
    for (let number = 0; number < count; number++) {
      if (view.getUint32(at, true) !== 0x02014b50) throw damaged();
      const method = view.getUint16(at + 10, true), crc = view.getUint32(at + 16, true);
      const packed = view.getUint32(at + 20, true), size = view.getUint32(at + 24, true);
      const [named, extra, comment] = [28, 30, 32].map((place) => view.getUint16(at + place, true));
      const local = view.getUint32(at + 42, true);
      const entry = new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + named));
      at += 46 + named + extra + comment;
      if ((total += size) > MOST_ARRAY_BYTES) throw new Error(`${name}: its arrays are larger than a page can hold`);
      if (view.getUint32(local, true) !== 0x04034b50) throw damaged();
      const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
      const content = bytes.subarray(start, start + packed);
      if (content.length !== packed || ![0, 8].includes(method)) throw damaged();
      const whole = method ? await inflate(content, size, name) : content.slice();
      if (whole.length !== size || ~crcOf(whole, -1) >>> 0 !== crc) throw damaged();
      found[entry.replace(/\.npy$/, "")] = readArray(whole, `${name}: ${entry}`);
    }
    return found;
  } catch (error) {
    throw error instanceof RangeError ? damaged() : error; // an offset beyond the end
  }
}

/** One .npy file: { data, shape }. */
function readArray(bytes, name) {
  const wrong = (what) => new Error(`${name} ${what}; export the model again`);
  const magic = [0x93, 78, 85, 77, 80, 89].every((letter, i) => bytes[i] === letter);
  if (!magic || bytes.length < 12) throw wrong("is no NumPy array");
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const [length, from] = bytes[6] === 1 ? [view.getUint16(8, true), 10] : [view.getUint32(8, true), 12];
  const header = new TextDecoder().decode(bytes.subarray(from, from + Math.min(length, 10_000)));
  const [, kind] = header.match(/'descr': *'([^']{1,8})'/) ?? [];
  const [, sizes] = header.match(/'shape': *\(([\d, ]*)\)/) ?? [];
  if (!(kind in KINDS) || sizes === undefined) throw wrong("is of a kind that a page cannot read");
  const shape = sizes.split(",").filter((each) => each.trim()).map(Number);
  const flat = shape.length < 2 || /'fortran_order': *False/.test(header);
  if (!flat) throw wrong("is laid out in an order that a page cannot read");
  const count = shape.reduce((product, each) => product * each, 1);
  const Kind = KINDS[kind];
  if (bytes.length - from - length !== count * Kind.BYTES_PER_ELEMENT) throw wrong("has another size than its header says");
  let data = new Kind(bytes.slice(from + length).buffer);
  if (data instanceof BigInt64Array || data instanceof BigUint64Array) data = Float64Array.from(data, Number); // indices, far below 2^53
  return { data, shape };
}
