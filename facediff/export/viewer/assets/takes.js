// A take as files: the motion as the page holds it, as an archive that facediff and NumPy read, the speech, and the keys.

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

/** The download of takes. */
class Takes {
  constructor(player) {
    this.player = player;
    this.facts = player.facts;
    find("taken").append(...this.facts.animations.map(({ name }, number) => new Option(name, number)));
    find("take-sound").hidden = this.facts.sound === null;
    find("take-motion").addEventListener("click", () => this.motion("npz"));
    find("take-glb").addEventListener("click", () => this.motion("glb"));
    find("take-sound").addEventListener("click", () => this.sound());
    find("take-keys").addEventListener("click", () => player.editor.save(this.number));
    find("taken").addEventListener("change", () => this.choose());
    find("downloads").addEventListener("click", () => this.open());
  }

  get number() {
    return Number(find("taken").value);
  }

  /** The dialog, with the take that is seen chosen. */
  open() {
    find("taken").value = this.player.comparison.seen[0];
    find("takes-said").textContent = "";
    this.choose();
    find("takes").showModal();
  }

  /** Another take may have no keys. */
  choose() {
    find("take-keys").disabled = !this.player.editor.directions[this.number].keys.length;
  }

  /** Download the chosen take as a file of a kind. */
  async motion(kind) {
    const buttons = [find("take-motion"), find("take-glb")];
    for (const button of buttons) button.disabled = true;
    find("takes-said").textContent = "packing the motion …";
    const { number } = this;
    const name = `${fileName(this.facts.animations[number].name)}.${kind}`;
    try {
      if (kind === "npz") download(name, "application/zip", await this.archive(number));
      else download(name, "model/gltf-binary", await this.scene(number));
      find("takes-said").textContent = `${name} is ready`;
    } catch (error) {
      find("takes-said").textContent = error.message;
    }
    for (const button of buttons) button.disabled = false;
  }

  async sound() {
    const name = fileName(this.facts.animations[this.number].name);
    download(`${name}.wav`, "audio/wav", [await readBlob(this.facts.sound)]);
  }

  /** The parts of an animation's archive, as `facediff animate -o take.npz` writes it, in mm. */
  async archive(number) {
    const { facts } = this;
    const face = this.player.faces[number], { animation } = face;
    const about = JSON.stringify({
      format: facts.archive,
      name: animation.name,
      frame_rate: facts.frameRate,
      unit: "mm",
      sample_rate: this.player.wav ? this.player.wav.rate : 16000,
      metadata: { ...animation.metadata, precision_of_positions: `${facts.step} mm, from a page` },
    });
    const letters = Uint32Array.from(about, (letter) => letter.codePointAt(0));
    const entries = [
      ["vertices", "<f4", [facts.frames, animation.vertices, 3], this.frames(face)],
      ["template", "<f4", [animation.vertices, 3], [bytesOf(face.template)]],
      ["faces", "<i4", [animation.triangles, 3], [bytesOf(face.faces)]],
      ["about", `<U${letters.length}`, [], [bytesOf(letters)]],
    ];
    if (face.colours) entries.push(["colours", "|u1", [animation.vertices, 3], [bytesOf(face.colours)]]);
    if (this.player.wav) {
      const { samples } = this.player.wav;
      entries.push(["speech", "<f4", [samples.length], [bytesOf(samples)]]);
    }
    if (animation.head !== null) {
      entries.push(["head", "<f4", [facts.frames, 6], [new Uint8Array(await readBlob(animation.head))]]);
    }
    if (animation.pairs !== null) {
      const pairs = new Uint8Array(await readBlob(animation.pairs));
      entries.push(["inner_lip_pairs", "<i4", [pairs.length / 8, 2], [pairs]]);
    }
    for (const [name, blob] of Object.entries(animation.regions)) {
      const indices = new Uint8Array(await readBlob(blob));
      entries.push([`region_${name}`, "<i4", [indices.length / 4], [indices]]);
    }
    async function* pieces(type, shape, parts) {
      yield npyHeader(type, shape);
      yield* parts;
    }
    return zip(entries.map(([name, type, shape, parts]) => [`${name}.npy`, pieces(type, shape, parts)]));
  }

  /** The parts of an animation's .glb, in metres. */
  async scene(number) {
    const { facts } = this;
    const face = this.player.faces[number], size = face.template.length;
    if (4 * size * facts.frames > GLB_MEMORY) {
      throw new Error("too much motion for a .glb made in a page: download the .npz, and run facediff export");
    }
    const offsetsOf = async () => {
      const offsets = new Float32Array(size * facts.frames);
      let at = 0;
      for await (const bytes of this.frames(face)) {
        const positions = new Float32Array(bytes.buffer);
        for (let i = 0; i < size; i++) offsets[at + i] = positions[i] - face.template[i];
        at += size;
      }
      return offsets;
    };
    const extras = { ...face.animation.metadata, tolerance_mm: GLB_TOLERANCE };
    return glb(face, offsetsOf, facts.frameRate, face.animation.name, extras);
  }

  /** Positions of all frames, as the page holds them: without the preview of changed keys. */
  async *frames(face) {
    const positions = new Float32Array(face.template.length);
    for (let frame = 0; frame < this.facts.frames; frame++) {
      await face.motion.load(face.motion.chunkOf(frame));
      place(positions, face.template, face.motion.at(frame), this.facts.step);
      yield bytesOf(positions).slice();
      if (frame % 8 === 7) await breathe();
    }
  }
}
