// A page that animates speech by itself: a recording or the microphone goes in, a worker computes, and the face speaks.

/** Bytes of motion that a page keeps of a recording. */
const MOST_MOTION = 1.2e9;
const MOST_FILE = 1e9;

/** What a recording became: offsets from the face at rest, frame by frame, in the model's unit. */
class Animated {
  constructor(name, samples, frames, size, frameRate) {
    Object.assign(this, { name, samples, frames, size, frameRate });
    this.offsets = new Float32Array(frames * size);
    this.ready = 0; // frames so far
    this.done = false;
  }

  at(frame) {
    return this.offsets.subarray(frame * this.size, (frame + 1) * this.size);
  }
}

class TalkingPage {
  constructor(facts) {
    this.facts = facts;
    if (!facts.rests) find("gate").checked = false;
    this.jobs = 0; // numbers of what the worker was asked
    this.job = null; // what it computes now
    this.animated = null;
    this.listening = null;
    this.shown = -1;
    this.playing = this.waits = false; // whether somebody wants it to play, and whether it waits for the model
    this.about = null;
    this.clock = new SilentClock(0);
    this.calm = matchMedia("(prefers-reduced-motion: reduce)");
  }

  /** Load the model by a worker. Args: what computes, wasm or webgpu. */
  async load(device) {
    this.stopListening();
    this.worker?.terminate();
    this.job = null;
    this.loaded = false;
    this.settle();
    if (location.protocol === "file:") throw new Error("a browser lets no page of a file load a model: run  facediff serve FOLDER  or put this folder on any web server");
    this.worker = new Worker("worker.js", { type: "module" });
    this.worker.onmessage = ({ data }) => this.answer(data);
    const opened = new Promise((resolve, reject) => {
      this.opening = { resolve, reject };
      this.worker.onerror = (event) => reject(new Error(`the worker does not start: ${event.message ?? "worker.js is missing"}`));
    });
    // Half of the cores: threads that wait for one another lose more than they gain where others need the cores too.
    const usual = Math.max(1, Math.min(4, Math.floor((navigator.hardwareConcurrency || 1) / 2)));
    const threads = crossOriginIsolated ? this.facts.threads ?? usual : 1;
    this.device = device;
    this.threads = threads;
    this.say("loading the model …", 0);
    this.send({ kind: "open", id: 0, base: new URL("model/", location.href).href, runtime: new URL("onnxruntime/", location.href).href, device, threads });
    const first = !this.about;
    await opened;
    this.loaded = true;
    this.inform();
    this.say(first ? "hear an example, open a recording, drop one here, or switch the microphone on" : "");
  }

  /** Show the face, which lies in the page, before anything is loaded. */
  async appear() {
    this.stage = new Stage(find("view"), find("stage"), await readMesh(this.facts.face), this.facts.face.frameRate);
    document.body.classList.add("ready");
  }

  /** What the model offers, while the rest of it still loads. */
  meet({ about, arrays }) {
    if (this.about) return;
    Object.assign(this, { about, arrays });
    this.size = 3 * arrays.templates.shape[1];
    this.fill();
  }

  send(message, transfer = []) {
    this.worker.postMessage(message, transfer);
  }

  /** A face at rest (3 V), in mm. */
  template(number) {
    return this.arrays.templates.data.slice(number * this.size, (number + 1) * this.size).map((value) => value * this.facts.millimetres);
  }

  /** The colours (3 V) of a face: its own, those of all faces, or null. */
  colours(number) {
    const { data, shape } = this.arrays.colours ?? { data: null, shape: [] };
    return shape.length === 3 ? data.slice(number * this.size, (number + 1) * this.size) : data;
  }

  /** Args: offsets from the face at rest, and the seconds of speech at which the head sways. */
  show(offsets, time) {
    this.stage.sway(find("sway").checked && !this.calm.matches ? time : null);
    this.scaled ??= new Float32Array(this.size);
    for (let i = 0; i < this.size; i++) this.scaled[i] = offsets[i] * this.facts.millimetres;
    this.stage.push(this.scaled);
  }

  /** Words on the stage. Args: also a share of something that takes long. */
  say(words, share) {
    if (find("words").textContent !== words) find("words").textContent = words;
    find("progress").hidden = share === undefined;
    if (share !== undefined) find("progress").value = share;
  }

  /** Put the model's names into the lists. */
  fill() {
    const { about } = this;
    const options = (id, names) => find(id).append(...names.map((name) => new Option(name, name)));
    options("identity", about.faces);
    options("style", about.styles);
    for (const id of ["style", "seed", "expressivity"]) find(id).closest("label").hidden = !this.offers(id);
    find("expressivity").value = about.usual_expressivity;
    const { name } = this.facts.face; // of a model that was changed since, perhaps no face
    find("identity").value = about.faces.includes(name) ? name : about.faces[0];
    this.suit();
    const usual = about.windows;
    const drawn = about.blending === "steps" ? {} : { ahead: 0 }; // no noise of the frames ahead
    this.delays = this.facts.delays.map((each) => ({ ...usual, past: 0, ...each, ...drawn })).filter((each) => each.seconds < usual.seconds);
    this.delays.push(usual);
    find("delay").append(...this.delays.map((plan, number) => new Option(`${(plan.seconds + plan.after).toFixed(1)} s`, number)));
  }

  /** Say what the model is, and what computes it. */
  inform() {
    const { about } = this, rows = [
      ["model", about.model], ["trained on", about.synthetic ? `${about.corpus} (synthetic)` : about.corpus], ...Object.entries(about.licences),
      ["mesh", `${this.size / 3} vertices, ${this.arrays.faces.shape[0]} triangles`], ["motion", `${about.frame_rate} frames a second`],
      ["weights", about.precision], ...(about.generation === "sampled" ? [["sampler", `${about.sampler}, ${about.steps.length} steps`]] : []),
      ["size", `${(Object.values(about.sizes).reduce((sum, each) => sum + each, 0) / 1e6).toFixed(1)} MB`],
      ["computed by", `${this.device === "webgpu" ? "WebGPU" : "WebAssembly"}, ${this.threads} ${this.threads === 1 ? "thread" : "threads"}`],
    ].map(([term, words]) => [term, String(words)]);
    find("about").replaceChildren(describe(rows));
  }

  /** Whether a choice means something to the model. */
  offers(choice) {
    const { style_source: source, generation, last_step: last } = this.about;
    return { style: source !== "none", seed: generation === "sampled", expressivity: last >= 0 }[choice];
  }

  /** The chosen face's own style, if it has one. */
  suit() {
    const name = find("identity").value;
    const style = [`${name}_lively`, name].find((each) => this.about.styles.includes(each));
    if (style) find("style").value = style;
  }

  /** Show the chosen face. */
  wear() {
    this.suit();
    const number = this.about.faces.indexOf(find("identity").value);
    this.stage.wear(this.template(number), this.colours(number));
  }

  /** What the reader has chosen. */
  get choices() {
    const seed = Number(find("seed").value), expressivity = Number(find("expressivity").value);
    const style = this.offers("style") ? find("style").value : undefined;
    return { identity: find("identity").value, style, seed, expressivity: this.offers("expressivity") ? expressivity : 1 };
  }

  /** What brings the mouth to rest in pauses, and looks as far ahead as the windows do; null for nothing. */
  gateOf(windows) {
    return find("gate").checked ? this.facts.gates[windows?.quick ? "quick" : "usual"] : null;
  }

  /** Buttons as what happens now allows. */
  settle() {
    const busy = Boolean(this.job), hears = Boolean(this.listening), ready = this.loaded;
    find("cancel").hidden = !busy;
    for (const button of [find("open"), ...find("examples").children]) button.disabled = !ready || busy || hears;
    find("again").disabled = !ready || busy || hears || !this.recording;
    find("microphone").disabled = !ready || busy;
    find("microphone").setAttribute("aria-pressed", String(hears));
    find("downloads").disabled = hears || !this.animated?.done;
    for (const id of ["play", "scrub"]) find(id).disabled = hears || !this.animated;
    for (const id of ["identity", "style", "delay", "device"]) find(id).disabled = busy || hears;
  }

  /** Animate a file that the reader has chosen. */
  async open(file) {
    this.clear();
    if (file.size > MOST_FILE) throw new Error(`${file.name}: is larger than a page can hold; run \`facediff animate\` on it`);
    this.say(`reading ${file.name} …`);
    const samples = await this.speechOf(file);
    const audio = find("sound");
    if (audio.src) URL.revokeObjectURL(audio.src);
    audio.src = URL.createObjectURL(file);
    this.recording = { name: file.name.replace(/\.[^.]*$/, ""), samples };
    await this.animate();
  }

  /** Animate a recording that lies next to the page. */
  async openExample(name) {
    const answer = await fetch(`recordings/${encodeURIComponent(name)}`);
    if (!answer.ok) throw new Error(`recordings/${name}: the server answers ${answer.status}; write the site anew with facediff serve`);
    await this.open(new File([await answer.blob()], name));
  }

  /** The samples of a recording, averaged to one channel, at the rate of the model. */
  async speechOf(file) {
    const bytes = await file.arrayBuffer();
    try {
      const { samples, rate } = readWav(bytes); // as exact as the file; browsers divide by 32767 and resample each in its own way
      return resampled(samples, rate, SAMPLE_RATE);
    } catch {} // any other file is the browser's
    let sound;
    try {
      sound = await new OfflineAudioContext(1, 1, SAMPLE_RATE).decodeAudioData(bytes);
    } catch {
      this.say("");
      throw new Error(`${file.name}: this browser cannot read it as sound; choose a .wav, .mp3, .ogg or .flac`);
    }
    const samples = new Float32Array(sound.length);
    for (let channel = 0; channel < sound.numberOfChannels; channel++) {
      const data = sound.getChannelData(channel);
      for (let i = 0; i < samples.length; i++) samples[i] += data[i] / sound.numberOfChannels;
    }
    return samples;
  }

  /** Animate the recording with what is chosen; resolves when it is done. */
  async animate(choices = this.choices, windows = null) {
    const { name, samples } = this.recording, { frame_rate: rate } = this.about;
    this.clear();
    const frames = new FrameClock(rate, this.about.clock).frames(samples.length);
    if (frames < 1) throw new Error(`${name}: is shorter than one frame; choose a longer recording`);
    if (4 * frames * this.size > MOST_MOTION) {
      throw new Error(`${name}: ${Math.floor(MOST_MOTION / 4 / this.size / rate)} s of motion are the most that this page keeps; run \`facediff animate\` on it`);
    }
    this.animated = new Animated(name, samples, frames, this.size, rate);
    this.clock = new SoundClock(find("sound"), rate);
    this.clock.loop = find("loop").getAttribute("aria-pressed") === "true";
    this.clock.seek(0);
    const id = (this.jobs += 1), facts = { frames: Math.max(1, frames), frameRate: rate }, wav = { rate: SAMPLE_RATE, samples };
    find("voice").hidden = false;
    find("scrub").max = Math.max(0, frames - 1);
    if (this.waveform) this.waveform.hear(facts, wav);
    else this.waveform = new Waveform(find("waveform"), find("voice-cursor"), facts, wav, (frame) => this.seek(frame));
    this.waveform.draw();
    this.say(`animating ${name} …`, 0);
    const gate = this.gateOf(windows);
    const finished = new Promise((resolve, reject) => (this.job = { id, choices, gate, windows, resolve, reject }));
    this.settle();
    this.send({ kind: "animate", id, samples, choices, gate, windows });
    return finished;
  }

  /** Nothing is shown or computed any more but the face at rest. */
  clear() {
    this.cancel();
    this.stopListening();
    this.pause();
    this.animated = null;
    this.shown = -1;
    find("message").hidden = true;
    this.stage.push(null);
    this.settle();
  }

  cancel() {
    if (!this.job) return;
    this.send({ kind: "cancel", id: this.job.id });
    this.job.resolve(false);
    this.job = null;
    this.animated = null;
    this.say("cancelled");
    this.settle();
  }

  /** What the worker says. */
  answer(data) {
    if (data.kind === "loading") this.say("loading the model …", data.share);
    else if (data.kind === "face") this.meet(data);
    else if (data.kind === "opened") this.opening.resolve(data);
    else if (data.kind === "failed") this.fail(data);
    else if (this.listening?.id === data.id) this.hear(data);
    else if (this.job?.id === data.id) this.progress(data);
    this.settle();
  }

  fail({ id, of, message }) {
    const error = new Error(message);
    this.say("");
    if (of === "open") this.opening.reject(error);
    else if (this.job?.id === id) {
      const { reject } = this.job;
      this.job = this.animated = null;
      reject(error);
    } else if (this.listening?.id === id) {
      this.stopListening();
      report(error);
    }
  }

  /** Frames of a recording have come. */
  progress(data) {
    const { animated, job } = this;
    if (data.kind === "frames") {
      animated.offsets.set(data.offsets, data.start * this.size);
      animated.ready = data.start + data.count;
      this.say(`animating ${animated.name} …`, animated.ready / animated.frames);
      if (data.start === 0) this.play();
    } else if (data.kind === "finished") {
      animated.done = true;
      animated.seconds = data.seconds;
      animated.names = data.names;
      animated.job = job;
      this.job = null;
      const spoken = animated.samples.length / SAMPLE_RATE;
      this.say(`${spoken.toFixed(1)} s of speech animated in ${data.seconds.toFixed(1)} s`);
      job.resolve(true);
    }
  }

  /** Frames of the microphone have come. */
  hear(data) {
    if (data.kind === "frames") this.listening.take(data.start, data.count, data.offsets);
    else if (data.kind === "heard") this.listening.done = data.samples;
  }

  /** This machine is too slow for the windows: go on with the next longer ones. */
  wait() {
    const next = Number(find("delay").value) + 1;
    if (next >= this.delays.length) return;
    find("delay").value = next;
    this.listen().catch(report);
  }

  async listen() {
    this.clear();
    const windows = this.delays[Number(find("delay").value)];
    const id = (this.jobs += 1), listening = new Listening(this, id, windows);
    this.listening = listening;
    this.settle();
    this.send({ kind: "listen", id, choices: this.choices, gate: this.gateOf(windows), windows });
    this.say("listening …");
    try {
      await listening.open();
    } catch (error) {
      listening.close();
      if (this.listening !== listening) return; // switched off meanwhile, and perhaps on again
      this.stopListening();
      const words = { NotAllowedError: "it was not allowed; allow it in the browser's bar", NotFoundError: "there is none; plug one in" };
      throw new Error(error.name in words ? `the microphone: ${words[error.name]}` : error.message);
    }
    if (this.listening !== listening) return listening.close(); // switched off meanwhile
    this.stage.perform(true);
  }

  stopListening(words = "") {
    if (!this.listening) return;
    this.listening.close();
    this.send({ kind: "cancel", id: this.listening.id });
    this.send({ kind: "finish", id: (this.jobs += 1) });
    this.listening = null;
    this.stage.perform(false);
    this.stage.push(null);
    this.say(words);
    this.settle();
  }

  async play() {
    if (!this.animated) return;
    this.playing = true;
    this.stage.perform(true);
    try {
      await this.clock.play();
    } catch (error) {
      if (error.name === "AbortError") return; // paused before it had begun
      const time = this.clock.time;
      this.clock = new SilentClock(this.animated.frames / this.animated.frameRate);
      this.clock.seek(time);
      if (error.name === "NotAllowedError") return this.pause(); // a browser that wants a click before sound
      await this.clock.play(); // a sound that cannot be played: the picture goes on without
    }
  }

  pause() {
    this.playing = this.waits = false;
    this.clock.pause();
    this.stage?.perform(false);
  }

  seek(frame) {
    if (!this.animated) return;
    const to = Math.max(0, Math.min(this.animated.frames - 1, Math.round(frame)));
    this.clock.seek(to / this.animated.frameRate);
    this.shown = -1;
  }

  step(frames) {
    if (!this.animated) return;
    this.pause();
    this.seek(this.frame + frames);
  }

  /** The frame that the clock is at. */
  get frame() {
    return frameAt(this.clock.time, this.animated.frameRate, this.animated.frames);
  }

  tick() {
    requestAnimationFrame((now) => {
      if (this.listening) this.listening.tick(now);
      else if (this.animated) this.follow();
      const pressed = find("play");
      if (pressed.classList.contains("playing") !== this.playing) {
        pressed.classList.toggle("playing", this.playing);
        pressed.setAttribute("aria-label", this.playing ? "Pause" : "Play");
      }
      this.tick();
    });
  }

  /** Show the frame that the clock is at; where the model is not as far yet, the clock waits. */
  follow() {
    const { animated, frame } = this;
    if (this.playing && !this.clock.playing) {
      const ahead = Math.min(animated.frames, frame + animated.frameRate);
      if (this.waits && (animated.done || animated.ready >= ahead)) {
        this.waits = false;
        this.clock.play().catch(() => this.pause());
      } else if (!this.waits && animated.done && frame >= animated.frames - 1) {
        this.playing = false;
        this.stage.perform(false);
      }
    }
    if (frame >= animated.ready) {
      if (this.clock.playing) {
        this.waits = true;
        this.clock.pause();
      }
      return;
    }
    if (frame === this.shown) return;
    this.shown = frame;
    this.show(animated.at(frame), frame / animated.frameRate);
    find("scrub").value = frame;
    find("scrub").style.setProperty("--done", animated.frames > 1 ? frame / (animated.frames - 1) : 1);
    find("scrub").setAttribute("aria-valuetext", `frame ${frame}, ${(frame / animated.frameRate).toFixed(2)} seconds`);
    find("time").textContent = `${seconds(frame / animated.frameRate)} / ${seconds(animated.frames / animated.frameRate)}`;
    find("frame").textContent = `frame ${frame} / ${animated.frames - 1}`;
    this.waveform.point(frame);
  }

  /** What is written about the animation in its files. */
  get metadata() {
    const { about, animated } = this, { choices, gate, windows } = animated.job;
    const steps = windows?.quick && about.quick_steps.length ? about.quick_steps : about.steps;
    const found = {
      generator: `facediff ${about.facediff}, in a browser`,
      checkpoint: this.facts.checkpoint,
      model: `${about.model}, exported in ${about.precision}`,
      corpus: about.synthetic ? `${about.corpus} (synthetic)` : about.corpus,
      ...about.licences,
      ...animated.names,
      ...(about.generation === "sampled" ? { seed: String(choices.seed), sampler: `${about.sampler}, ${steps.length} steps` } : {}),
    };
    if (gate) found["voice gate"] = "energy";
    if (choices.expressivity !== 1) found.expressivity = String(choices.expressivity);
    return found;
  }

  /** The parts of the animation's archive, as `facediff animate -o OUT.npz` writes it. */
  archive() {
    const { about, arrays, animated, size } = this;
    const face = about.faces.indexOf(animated.names.identity);
    const template = arrays.templates.data.slice(face * size, (face + 1) * size);
    const words = { format: this.facts.archive, name: animated.name, frame_rate: about.frame_rate, unit: about.unit, sample_rate: SAMPLE_RATE, metadata: this.metadata };
    async function* frames() {
      const positions = new Float32Array(size);
      for (let frame = 0; frame < animated.frames; frame++) {
        const offsets = animated.at(frame);
        for (let i = 0; i < size; i++) positions[i] = template[i] + offsets[i];
        yield bytesOf(positions).slice();
        if (frame % 8 === 7) await breathe();
      }
    }
    const indices = ({ data }) => [bytesOf(Int32Array.from(data))];
    const entries = [
      ["vertices", "<f4", [animated.frames, size / 3, 3], frames()],
      ["template", "<f4", [size / 3, 3], [bytesOf(template)]],
      ["faces", "<i4", arrays.faces.shape, indices(arrays.faces)],
      textEntry("about", JSON.stringify(words)),
      ["speech", "<f4", [animated.samples.length], [bytesOf(animated.samples)]],
    ];
    if (arrays.colours) entries.push(["colours", "|u1", [size / 3, 3], [bytesOf(this.colours(face))]]);
    for (const [name, array] of Object.entries(arrays)) {
      if (name === "inner_lip_pairs" || name.startsWith("region_")) entries.push([name, "<i4", array.shape, indices(array)]);
    }
    return npz(entries);
  }

  /** The parts of the animation's .glb, in metres. */
  async scene() {
    const { animated, facts } = this;
    const offsetsOf = async () => animated.offsets.map((value) => value * facts.millimetres);
    const size = this.stage.face.template.length;
    const shapes = await compressed(offsetsOf, animated.offsets.length / size, size);
    return glb(this.stage.face, shapes, animated.frameRate, animated.name, { ...this.metadata, tolerance_mm: GLB_TOLERANCE });
  }

  async download(kind) {
    const name = `${fileName(this.animated.name)}.${kind}`;
    find("takes-said").textContent = "packing the motion …";
    try {
      if (kind === "npz") download(name, "application/zip", await this.archive());
      else download(name, "model/gltf-binary", await this.scene());
      find("takes-said").textContent = `${name} is ready`;
    } catch (error) {
      find("takes-said").textContent = error.message;
    }
  }

  connect() {
    const click = (id, action) => find(id).addEventListener("click", () => Promise.resolve(action()).catch(report));
    const press = (id) => {
      const on = find(id).getAttribute("aria-pressed") !== "true";
      find(id).setAttribute("aria-pressed", String(on));
      return on;
    };
    click("open", () => find("file").click());
    click("microphone", () => (this.listening ? this.stopListening("the microphone is off") : this.listen()));
    click("cancel", () => this.cancel());
    click("again", () => this.animate());
    click("play", () => (this.playing ? this.pause() : this.play()));
    click("loop", () => (this.clock.loop = press("loop")));
    click("mute", () => (find("sound").muted = press("mute")));
    click("wireframe", () => this.stage.setEdges(press("wireframe")));
    click("reset", () => this.stage.camera.reset());
    click("take-motion", () => this.download("npz"));
    click("take-glb", () => this.download("glb"));
    find("file").addEventListener("change", () => {
      const [file] = find("file").files;
      find("file").value = "";
      if (file) this.open(file).catch(report);
    });
    for (const name of this.facts.recordings) {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: name.replace(/\.[^.]*$/, ""), disabled: true });
      button.addEventListener("click", () => this.openExample(name).catch(report));
      find("examples").append(button);
    }
    find("examples").hidden = !this.facts.recordings.length;
    find("identity").addEventListener("change", () => {
      this.pause();
      this.animated = null;
      this.wear();
      this.settle();
    });
    find("device").addEventListener("change", () => this.load(find("device").value).catch(report));
    find("scrub").addEventListener("input", () => this.seek(Number(find("scrub").value)));
    const stage = find("stage");
    stage.addEventListener("dragover", (event) => {
      event.preventDefault();
      stage.classList.add("over");
    });
    stage.addEventListener("dragleave", () => stage.classList.remove("over"));
    stage.addEventListener("drop", (event) => {
      event.preventDefault();
      stage.classList.remove("over");
      const [file] = event.dataTransfer.files;
      if (file && !find("open").disabled) this.open(file).catch(report);
    });
    addEventListener("keydown", (event) => this.key(event));
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (event.target.closest("select, input:not([type=range])")) return;
    if (event.key === " " && event.target.closest("button")) return; // the button's own key
    const press = (id) => () => find(id).click(), { camera } = this.stage ?? {};
    const leap = event.shiftKey && this.about ? Math.round(this.about.frame_rate) : 1;
    const actions = {
      " ": press("play"), o: press("open"), v: press("microphone"), l: press("loop"), m: press("mute"), e: press("wireframe"), r: press("reset"),
      ArrowLeft: () => this.step(-leap), ArrowRight: () => this.step(leap), Home: () => this.seek(0), End: () => this.seek(Infinity),
      "+": () => camera?.magnify(1.15), "-": () => camera?.magnify(1 / 1.15),
      a: () => camera?.turn(-0.1, 0), d: () => camera?.turn(0.1, 0), w: () => camera?.turn(0, 0.1), s: () => camera?.turn(0, -0.1),
      i: () => find("information").showModal(), "?": () => find("keys").showModal(),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action) return;
    event.preventDefault();
    action();
  }
}

async function start() {
  const facts = JSON.parse(find("facts").textContent);
  const asked = Number(new URLSearchParams(location.search).get("threads"));
  if (Number.isInteger(asked) && asked >= 1 && asked <= 64) facts.threads = asked;
  const page = new TalkingPage(facts);
  // What scripts and tests may use.
  window.facediff = {
    errors,
    page,
    ready: false,
    get frame() { return page.shown; },
    get playing() { return page.playing; },
    get finished() { return Boolean(page.animated?.done); },
    get listening() {
      const { listening } = page;
      return listening && { lag: listening.lag, dropped: listening.dropped, shown: listening.shown, lost: listening.lost, sent: listening.sent };
    },
    resampler: (from, to) => new Resampler(from, to),
  };
  connectDialogs();
  page.connect();
  if (typeof DecompressionStream === "undefined") {
    throw new Error("this browser is too old for this page: use Chrome or Edge 111, Firefox 114, Safari 16.4 or newer");
  }
  await page.appear();
  await page.load("wasm");
  find("computed").hidden = !(navigator.gpu && (await navigator.gpu.requestAdapter().catch(() => null)));
  page.tick();
  page.settle();
  window.facediff.ready = true;
}

start().catch(report);
