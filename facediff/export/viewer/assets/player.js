// Puts the parts together: reads the page's data, follows the clock, and listens to buttons and keys.

/** One animation, ready to be drawn. */
async function readFace(facts, animation) {
  const mesh = await readMesh(animation), positions = mesh.template.slice();
  return {
    ...mesh,
    animation,
    positions,
    normals: new Float32Array(positions.length),
    opening: animation.opening === null ? null : new Float32Array(await readBlob(animation.opening)),
    distances: animation.compared ? new Float32Array(animation.vertices) : null,
    centre: animation.centre,
    motion: new Motion(facts, animation, report),
  };
}

class Player {
  constructor(facts, faces, ramp, wav) {
    Object.assign(this, { facts, faces });
    this.wanted = 0;
    this.shown = -1;
    this.dirty = true;
    this.heat = false;
    this.edges = false;
    this.highest = facts.heat ? facts.heat.highest : 0;
    this.waiting = [];
    this.stats = { shown: 0, late: 0, workMs: 0 };
    this.pace = new Pace(facts.frameRate);
    this.view = new TimeView(facts.frames / facts.frameRate, () => this.redrawPlots());
    this.extent = [0, 1, 2].map((axis) => Math.max(...facts.animations.map((animation) => animation.extent[axis])));
    this.clock = new SilentClock(facts.frames / facts.frameRate);
    this.scene = new Scene(find("view"), faces, ramp);
    this.camera = new Camera(find("stage"), () => this.stir());
    this.panels = new Panels(facts, () => (this.dirty = true));
    this.wav = wav ? readWav(wav) : null;
    this.comparison = new Comparison(facts, this.panels.boxes, () => this.stir());
    const lines = faces.flatMap(({ opening }, number) => (opening ? [{ values: opening, number }] : []));
    find("opening").hidden = !lines.length;
    const toFrame = (frame) => this.seek(frame);
    this.plots = lines.length ? [new Curve(find("curve"), find("cursor"), lines, facts, toFrame, this.view)] : [];
    find("voice").hidden = !wav;
    if (wav) this.plots.push(new Waveform(find("waveform"), find("voice-cursor"), facts, this.wav, toFrame, this.view));
    if (facts.sounds.length) {
      find("sounds-place").hidden = find("voice").hidden = false;
      find("waveform").parentElement.hidden = !wav;
      this.plots.push(new Sounds(find("sounds"), find("sounds-cursor"), facts, toFrame, this.view));
    }
    this.editor = new Editor(this);
    this.takes = new Takes(this);
    this.plots.push(this.editor);
  }

  /** Let an audio element be the clock; without it, or if it cannot be played, the machine's clock serves. */
  connectSound(wav) {
    if (!wav) return;
    const audio = find("sound");
    audio.addEventListener("error", () => {
      report("this browser cannot play the page's sound; the picture goes on without");
      const { playing } = this.clock, silent = new SilentClock(this.facts.frames / this.facts.frameRate);
      silent.seek(this.wanted / this.facts.frameRate);
      Object.assign(silent, { loop: audio.loop, speed: audio.playbackRate }); // as the controls show
      this.clock = silent;
      if (playing) this.play();
    }, { once: true });
    audio.addEventListener("ended", () => (this.wanted = this.facts.frames - 1));
    audio.src = URL.createObjectURL(new Blob([wav], { type: "audio/wav" }));
    this.clock = new SoundClock(audio, this.facts.frameRate);
  }

  get playing() {
    return this.clock.playing;
  }

  async play() {
    this.pace.start();
    try {
      await this.clock.play();
    } catch (error) {
      if (error.name !== "AbortError") report(error); // paused before it had begun
    }
  }

  pause() {
    this.wanted = frameAt(this.clock.time, this.facts.frameRate, this.facts.frames);
    this.clock.pause();
  }

  toggle() {
    return this.playing ? this.pause() : this.play();
  }

  /** Go to a frame; the promise is kept when it is on the screen. */
  seek(frame) {
    this.wanted = Math.max(0, Math.min(this.facts.frames - 1, Math.round(frame)));
    this.clock.seek(this.wanted / this.facts.frameRate);
    const { wanted } = this;
    return new Promise((resolve) => this.waiting.push({ wanted, resolve }));
  }

  /** Steps are taken standing still. */
  step(frames) {
    if (this.playing) this.pause();
    return this.seek(this.wanted + frames);
  }

  setHeat(on) {
    this.heat = on && Boolean(this.facts.heat);
    this.shown = -1; // distances are computed only while they are shown
    this.panels.showHeat(this.heat, this.highest);
  }

  /** Show the edges of the triangles, or not. */
  setEdges(on) {
    this.edges = on;
    this.dirty = true;
    this.panels.press("wireframe", on);
  }

  /** Draw again, quickly: more changes are likely to follow. */
  stir() {
    this.dirty = true;
    this.movedAt = performance.now();
  }

  /** Make the shown frame again, as changed keys have it. */
  redraw() {
    this.shown = -1;
    this.stir();
  }

  /** Draw the plots before the next picture, once however often the view has changed. */
  redrawPlots() {
    this.drawing ??= requestAnimationFrame(() => {
      this.drawing = null;
      for (const plot of this.plots) plot.draw();
    });
  }

  tick() {
    requestAnimationFrame(() => this.tick());
    const started = performance.now();
    const { playing } = this;
    if (playing) this.pace.beat(started);
    const still = !playing && !(started - this.movedAt < STILL_MS);
    if (still !== this.still) this.dirty = true; // in another sharpness
    this.still = still;
    if (playing) this.wanted = frameAt(this.clock.time, this.facts.frameRate, this.facts.frames);
    if (this.scene.fresh) this.shown = -1;
    const changed = this.wanted !== this.shown && this.prepare(this.wanted);
    if (changed || this.dirty) {
      this.scene.resize(still ? this.scene.finest : playing ? this.pace.sharpness : 1);
      this.scene.draw(this.comparison.views(), this.camera, this.extent, this.heat ? this.highest : 0, this.edges);
      this.dirty = false;
    }
    if (changed) {
      this.stats.shown += 1;
      this.stats.workMs += (performance.now() - started - this.stats.workMs) / Math.min(this.stats.shown, 30);
    }
    this.panels.showState(this);
    this.waiting = this.waiting.filter(({ wanted, resolve }) => {
      const done = wanted === this.shown || this.wanted !== wanted;
      if (done) resolve(this.shown);
      return !done;
    });
  }

  /** Bring a frame of every animation to the graphics card; false while one is still being unpacked. */
  prepare(frame) {
    const steps = this.faces.map((face) => face.motion.at(frame));
    if (steps.some((each) => !each)) {
      this.stats.late += this.playing ? 1 : 0;
      return false;
    }
    this.faces.forEach((face, number) => {
      place(face.positions, face.template, steps[number], this.facts.step);
      this.editor.preview(number, face, frame);
      orient(face.normals, face.positions, face.faces);
    });
    this.faces.forEach((face, number) => {
      if (this.heat && face.distances) {
        const found = compare(face.distances, face.positions, this.faces[this.facts.truth].positions);
        this.panels.showError(number, found);
      }
      this.scene.upload(number);
    });
    this.shown = frame;
    this.scene.fresh = false;
    this.view.follow(frame / this.facts.frameRate);
    for (const plot of this.plots) plot.point(frame);
    return true;
  }
}

async function start() {
  const facts = JSON.parse(find("facts").textContent);
  const began = performance.now();
  const player = { current: null };
  // What scripts and tests may use; frame, time (s) and positions (mm) are those of the picture that is drawn.
  window.facediff = {
    format: facts.format,
    facts,
    errors,
    ready: false,
    get frame() { return player.current ? player.current.shown : -1; },
    get time() { return player.current ? player.current.shown / facts.frameRate : 0; },
    get clock() { return player.current ? player.current.clock.time : 0; },
    get playing() { return Boolean(player.current && player.current.playing); },
    get stats() { return player.current ? { ...player.current.stats } : {}; },
    play: () => player.current.play(),
    pause: () => player.current.pause(),
    seek: (frame) => player.current.seek(frame),
    heat: (on) => player.current.setHeat(on),
    wireframe: (on) => player.current.setEdges(on),
    compare: (layout) => player.current.comparison.arrange(layout),
    swap: () => player.current.comparison.swap(),
    get views() { return player.current.comparison.views(); },
    get direction() { return player.current.editor.direction.text(); },
    directed: (name, time, easing) => player.current.editor.direction.value(name, time, easing),
    openKeys: (text) => player.current.editor.direction.open(text),
    direct: (on) => player.current.editor.show(on),
    get stretch() { return [player.current.view.from, player.current.view.to]; },
    seen: (name) => player.current.editor.addLane(name).seen,
    turn: (yaw, pitch) => player.current.camera.turn(yaw, pitch),
    positions: (number) => player.current.faces[number].positions,
    distances: (number) => player.current.faces[number].distances,
    sky: (number) => player.current.faces[number].sky,
  };
  fillInformation(find("about"), facts);
  connectDialogs();
  if (typeof DecompressionStream === "undefined") {
    throw new Error("this browser is too old for this page: use Chrome or Edge 111, Firefox 113, Safari 16.4 or newer");
  }
  const faces = await Promise.all(facts.animations.map((animation) => readFace(facts, animation)));
  const ramp = facts.heat ? new Uint8Array(await readBlob(facts.heat.ramp)) : null;
  const wav = facts.sound === null ? null : await readBlob(facts.sound);
  player.current = new Player(facts, faces, ramp, wav);
  player.current.panels.connect(player.current, ramp);
  player.current.connectSound(wav);
  await player.current.editor.readPreviews(faces);
  const drawn = player.current.seek(0);
  player.current.tick();
  await drawn;
  player.current.stats.readyMs = performance.now() - began;
  window.facediff.ready = true;
  document.body.classList.add("ready");
}

start().catch(report);
