// Files that a page gives its reader: zip archives of NumPy's arrays, as facediff and NumPy read them.

/** Displacements in mm, vertex by vertex, from a blob that holds steps, axis by axis. */
async function readField(blob, step, vertices) {
  const steps = new Int16Array(await readBlob(blob));
  return Float32Array.from(steps, (_, i) => steps[(i % 3) * vertices + Math.floor(i / 3)] * step);
}

/** A name as a file may have it. */
const fileName = (name) => name.replace(/[^\p{L}\p{N}._ -]+/gu, "_").trim() || "take";

/** Give the reader a file. Args: its name, its media type, and its parts. */
function download(name, type, parts) {
  const link = make("a");
  link.href = URL.createObjectURL(new Blob(parts, { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}

const CRC_TABLE = Uint32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let bit = 0; bit < 8; bit++) value = value & 1 ? (value >>> 1) ^ 0xedb88320 : value >>> 1;
  return value;
});

function crcOf(bytes, crc) {
  for (let i = 0; i < bytes.length; i++) crc = CRC_TABLE[(crc ^ bytes[i]) & 255] ^ (crc >>> 8);
  return crc;
}

/** Deflate what comes in pieces: the parts, their size, and size and check sum of what went in. */
async function deflate(pieces) {
  const stream = new CompressionStream("deflate-raw");
  const reading = new Response(stream.readable).blob();
  const writer = stream.writable.getWriter();
  let crc = -1, size = 0;
  for await (const bytes of pieces) {
    crc = crcOf(bytes, crc);
    size += bytes.length;
    await writer.write(bytes);
  }
  await writer.close();
  return { blob: await reading, crc: ~crc >>> 0, size };
}

/** The parts of a zip archive. Entries are [name, pieces of bytes]. */
async function zip(entries) {
  const parts = [], directory = [];
  let offset = 0;
  for (const [name, pieces] of entries) {
    const { blob, crc, size } = await deflate(pieces);
    const letters = new TextEncoder().encode(name);
    const header = (signature, length) => {
      const view = new DataView(new ArrayBuffer(length + letters.length));
      const at = length === 46 ? 6 : 4; // the directory's entries begin with one number more
      view.setUint32(0, signature, true);
      if (length === 46) view.setUint16(4, 20, true);
      view.setUint16(at, 20, true); // version 2.0
      view.setUint16(at + 2, 0x800, true); // names in UTF-8
      view.setUint16(at + 4, 8, true); // deflate
      view.setUint16(at + 8, 0x21, true); // 1980-01-01: equal takes give equal files
      [crc, blob.size, size].forEach((number, i) => view.setUint32(at + 10 + 4 * i, number, true));
      view.setUint16(at + 22, letters.length, true);
      new Uint8Array(view.buffer).set(letters, length);
      return view;
    };
    const central = header(0x02014b50, 46);
    central.setUint32(42, offset, true);
    directory.push(central);
    parts.push(header(0x04034b50, 30), blob);
    offset += 30 + letters.length + blob.size;
  }
  const end = new DataView(new ArrayBuffer(22));
  end.setUint32(0, 0x06054b50, true);
  end.setUint16(8, entries.length, true);
  end.setUint16(10, entries.length, true);
  end.setUint32(12, directory.reduce((sum, each) => sum + each.byteLength, 0), true);
  end.setUint32(16, offset, true);
  return [...parts, ...directory, end];
}

/** The beginning of a .npy file. */
function npyHeader(type, shape) {
  const words = `{'descr': '${type}', 'fortran_order': False, 'shape': (${shape.map((each) => `${each},`).join(" ")}), }`;
  const text = words.padEnd(Math.ceil((words.length + 11) / 64) * 64 - 11) + "\n";
  const bytes = new Uint8Array(10 + text.length);
  bytes.set([0x93, 78, 85, 77, 80, 89, 1, 0, text.length & 255, text.length >> 8]);
  bytes.set(new TextEncoder().encode(text), 10);
  return bytes;
}

const bytesOf = (array) => new Uint8Array(array.buffer, array.byteOffset, array.byteLength);

/** The parts of a .npz archive. Entries are [name, type, shape, pieces of bytes]. */
function npz(entries) {
  async function* pieces(type, shape, parts) {
    yield npyHeader(type, shape);
    yield* parts;
  }
  return zip(entries.map(([name, type, shape, parts]) => [`${name}.npy`, pieces(type, shape, parts)]));
}

/** Text as an array of NumPy, an entry of an archive. */
function textEntry(name, text) {
  const letters = Uint32Array.from(text, (letter) => letter.codePointAt(0));
  return [name, `<U${letters.length}`, [], [bytesOf(letters)]];
}
