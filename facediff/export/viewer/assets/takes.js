// A take as files: the motion as the page holds it, as an archive that facediff and NumPy read, the speech, and the keys.

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
      ...(animation.weighted && { space: animation.weighted.space }),
      metadata: { ...animation.metadata, precision_of_positions: `${facts.step} mm, from a page` },
    });
    const entries = [
      ["vertices", "<f4", [facts.frames, animation.vertices, 3], this.frames(face)],
      ["template", "<f4", [animation.vertices, 3], [bytesOf(face.template)]],
      ["faces", "<i4", [animation.triangles, 3], [bytesOf(face.faces)]],
      textEntry("about", about),
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
    if (animation.weighted) {
      const { values, channels } = animation.weighted;
      entries.push(["values", "<f4", [facts.frames, channels], [new Uint8Array(await readBlob(values))]]);
    }
    for (const [name, blob] of Object.entries(animation.regions)) {
      const indices = new Uint8Array(await readBlob(blob));
      entries.push([`region_${name}`, "<i4", [indices.length / 4], [indices]]);
    }
    return npz(entries);
  }

  /** The parts of an animation's .glb, in metres. */
  async scene(number) {
    const { facts } = this;
    const face = this.player.faces[number], size = face.template.length;
    const { name, metadata } = face.animation;
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
    const extras = { ...metadata, tolerance_mm: GLB_TOLERANCE };
    return glb(face, await compressed(offsetsOf, facts.frames, size), facts.frameRate, name, extras);
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
