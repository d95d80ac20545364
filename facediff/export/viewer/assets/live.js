// A performance while it happens: frames and speech come over a WebSocket, and are shown and heard together.

const HEADER = 24, MESH = 0, FRAME = 1, SPEECH = 2; // as the receiver's description has them
/** Waits between attempts to connect, in ms; the last one is repeated. */
const RETRIES = [250, 500, 1000, 2000, 4000];
const SILENCE_MS = 1500; // without a frame: nobody performs
const LATE_S = 0.5; // a lag that anybody notices
/** Seconds: that a picture takes to the screen, until it is measured; that both may be apart; of speech that waits for its
 * frames; by which the face is held at most for a loudspeaker that is slower, as wireless ones are. */
const DRAWN = 0.03, APART = 0.04, KEPT = 60, LONGEST_HOLD = 0.5;

/** Plays speech with the frames of the same time, however much later than the speech they come. */
class DelayedSpeech {
  constructor(rate) {
    this.rate = rate;
    this.on = false;
    this.context = null; // browsers give none before a person has clicked
    this.delay = null; // seconds by the page's clock at which frames of time 0 were shown
    this.pieces = []; // speech whose frames are still to come, in its order
    this.planned = null; // times of speech and of the sound device at which what is planned ends
    this.played = 0;
    this.drawn = DRAWN; // seconds from a frame's arrival until it is on the screen
    this.hold = 0; // seconds by which frames wait for the sound
    this.anchors = 0; // times that the sound had to be moved to the picture
  }

  /**
   * The time of the sound device that leaves the loudspeaker at a time by the page's clock: what is being computed is heard
   * later by what the browser buffers and the device takes.
   */
  heard(now) {
    const { context } = this, stamp = context.getOutputTimestamp?.();
    if (stamp?.performanceTime > 0) return stamp.contextTime + now - stamp.performanceTime / 1000;
    return context.currentTime - (context.outputLatency || context.baseLatency || 0);
  }

  /** Seconds that sound takes from being computed to the loudspeaker, as the browser says. */
  latency(now) {
    return Math.max(0, this.context.currentTime - this.heard(now));
  }

  /** Seconds by which the speech that is heard is ahead of the face that is seen (behind it if negative), or null. */
  ahead(now) {
    if (!this.context || !this.planned || this.delay === null || this.planned.at < this.heard(now)) return null;
    return this.planned.time - (this.planned.at - this.heard(now)) - (now - this.delay - this.drawn);
  }

  /** A frame that came at a time began to be drawn at another one, with so many seconds between pictures. */
  drew(came, began, interval) {
    this.drawn += (Math.min(0.1, began + interval - came) - this.drawn) / 50;
  }

  /** Another performance, whose times begin again. */
  begin() {
    this.delay = this.planned = null;
    this.pieces = [];
  }

  /** Switch the sound on or off. */
  async toggle() {
    this.on = !this.on;
    this.planned = null;
    this.hold = 0;
    for (const piece of this.pieces) piece.planned = false;
    await this.context?.close(); // what is planned is not heard any more
    this.context = this.on ? new AudioContext() : null;
    await this.context?.resume();
    this.plan(performance.now() / 1000);
  }

  /** A frame of a time came onto the page. */
  frame(time, now) {
    const delay = now - time;
    // Frames come a little early or late; their mean does not.
    this.delay = this.delay === null || Math.abs(delay - this.delay) > 1 ? delay : this.delay + (delay - this.delay) / 20;
    while (this.pieces.length && this.pieces[0].end < time) this.pieces.shift();
    this.plan(now);
  }

  /** Speech that begins at a time. */
  speech(time, samples, now) {
    this.pieces.push({ time, samples, end: time + samples.length / this.rate, planned: false });
    while (this.pieces[0].end < time - KEPT) this.pieces.shift();
    this.plan(now);
  }

  plan(now) {
    if (!this.context || this.delay === null) return;
    for (const piece of this.pieces) {
      if (piece.planned) continue;
      piece.planned = true;
      const { time, samples, end } = piece;
      const wanted = this.heard(now) + (time + this.delay + this.drawn - now);
      const follows = this.planned && Math.abs(this.planned.time - time) < 1e-3 && Math.abs(this.planned.at - wanted) < APART;
      const at = follows ? this.planned.at : wanted;
      const late = this.context.currentTime - at;
      if (late > 0) { // too late to be heard with its face, which waits from now on
        this.hold = Math.min(LONGEST_HOLD, this.hold + Math.min(late, 0.05));
        continue;
      }
      if (late < -0.1) this.hold = Math.max(0, this.hold - 0.001); // there is time to spare again
      if (!follows) this.anchors += 1;
      const buffer = this.context.createBuffer(1, samples.length, this.rate);
      buffer.copyToChannel(Float32Array.from(samples, (each) => each / 32767), 0);
      const source = this.context.createBufferSource();
      source.buffer = buffer;
      source.connect(this.context.destination);
      source.start(at);
      this.planned = { time: end, at: at + end - time };
      this.played += samples.length;
    }
  }
}

class LivePage {
  constructor() {
    this.attempts = 0;
    this.connections = 0;
    this.stage = null;
    this.speech = null;
    this.arrivals = []; // of the last second, in ms
    this.stats = { received: 0, missed: 0, dropped: 0, lag: 0, index: -1, time: 0 };
    this.last = -Infinity;
    this.connect();
    setInterval(() => this.showNumbers(), 250);
  }

  connect() {
    const socket = new WebSocket(`ws://${location.host}/live`);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      try {
        typeof data === "string" ? this.begin(JSON.parse(data)) : this.take(data);
      } catch (error) {
        report(error);
        socket.close();
      }
    };
    socket.onclose = () => this.again();
  }

  /** Try to connect again, less and less often. */
  again() {
    const wait = RETRIES[Math.min(this.attempts, RETRIES.length - 1)];
    this.attempts += 1;
    this.stage?.perform(false);
    document.body.classList.add("lost");
    this.say("Nobody performs here; trying to connect again …");
    setTimeout(() => this.connect(), wait);
  }

  say(words) {
    if (find("state").textContent !== words) find("state").textContent = words;
  }

  begin(about) {
    if (about.format !== this.format()) throw new Error("the performance has another format: load this page again");
    // What is on the graphics card belongs to one mesh.
    if (this.about && this.about.mesh !== about.mesh) return location.reload();
    this.about = about;
    this.attempts = 0;
    this.connections += 1;
    this.stats.index = -1;
    document.body.classList.remove("lost");
    this.say("Connected: waiting for frames");
    document.querySelector("h1").textContent = about.subject;
    find("about").replaceChildren(
      describe([["frames a second", String(about.frameRate)], ...Object.entries(about.metadata)]),
      make("p", "fine", `Positions are rounded to ${about.step} mm on each axis.`)
    );
    find("sound").hidden = !about.speech;
    if (about.speech) this.speech ??= new DelayedSpeech(about.sampleRate);
    this.speech?.begin();
  }

  format() {
    return JSON.parse(find("facts").textContent).format;
  }

  take(data) {
    const view = new DataView(data);
    const kind = view.getUint8(0);
    if (kind === MESH) this.wear(view, data);
    else if (kind === FRAME) this.show(view, data);
    else if (kind === SPEECH) this.speech?.speech(view.getFloat64(16, true), new Int16Array(data, HEADER), performance.now() / 1000);
  }

  wear(view, data) {
    const [vertices, triangles, coloured] = [4, 8, 12].map((at) => view.getUint32(at, true));
    if (this.stage) return;
    const template = new Float32Array(data, HEADER, 3 * vertices);
    const faces = new Uint32Array(data, HEADER + 12 * vertices, 3 * triangles);
    const colours = coloured ? new Uint8Array(data, HEADER + 12 * vertices + 12 * triangles, 3 * vertices) : null;
    this.offsets = new Float32Array(3 * vertices);
    this.stage = new Stage(find("view"), find("stage"), { template, faces, colours }, this.about.frameRate);
    document.body.classList.add("ready");
  }

  show(view, data) {
    const now = performance.now();
    const index = view.getUint32(4, true), time = view.getFloat64(16, true);
    this.socket.send(String(index));
    const { offsets, stats } = this;
    const steps = new Int16Array(data, HEADER);
    if (steps.length !== offsets.length) throw new Error("a frame has another number of vertices than the face");
    for (let i = 0; i < offsets.length; i++) offsets[i] = this.about.step * steps[i];
    const hold = this.speech?.context ? this.speech.hold : 0;
    if (hold) {
      const kept = offsets.slice();
      setTimeout(() => this.stage.push(kept), 1000 * hold);
    } else this.stage.push(offsets);
    if (this.speech) this.watchPicture(now);
    if (!this.stage.performing) this.stage.perform(true);
    if (stats.index >= 0) stats.missed += Math.max(0, index - stats.index - 1);
    Object.assign(stats, { index, time, dropped: view.getUint32(8, true), lag: view.getFloat32(12, true) });
    stats.received += 1;
    this.last = now;
    this.arrivals.push(now);
    this.speech?.frame(time, now / 1000 + hold);
    this.say("Live");
  }

  /** Measure how long a frame that came now takes to the screen: until a picture begins, and one more. */
  watchPicture(came) {
    requestAnimationFrame((began) => requestAnimationFrame((next) => this.speech.drew(came / 1000, began / 1000, Math.min(0.05, (next - began) / 1000))));
  }

  showNumbers() {
    const now = performance.now(), { stats } = this;
    while (this.arrivals.length && this.arrivals[0] < now - 1000) this.arrivals.shift();
    const performing = now - this.last < SILENCE_MS;
    if (!performing && this.stage?.performing) {
      this.stage.perform(false);
      if (this.socket.readyState === WebSocket.OPEN) this.say("Connected: waiting for frames");
    }
    document.body.classList.toggle("late", performing && stats.lag > LATE_S);
    find("lag").textContent = performing ? `${Math.round(1000 * stats.lag)} ms` : "–";
    find("rate").textContent = performing ? `${this.arrivals.length} frames/s` : "–";
    find("dropped").textContent = stats.received ? String(stats.missed) : "–";
    const { speech } = this, ahead = speech?.ahead(now / 1000) ?? null;
    find("apart").parentElement.hidden = !speech?.on;
    if (speech?.on) {
      const words = ahead === null ? "–" : `${Math.abs(Math.round(1000 * ahead))} ms ${ahead > 0 ? "before" : "after"} the face`;
      find("apart").textContent = `${words}; output ${Math.round(1000 * speech.latency(now / 1000))} ms`;
    }
    find("time").textContent = stats.received ? `${stats.time.toFixed(1)} s` : "–";
  }

  press(id, on) {
    find(id).setAttribute("aria-pressed", String(on));
  }

  controls() {
    const sound = async () => {
      if (!this.speech) return;
      await this.speech.toggle();
      this.press("sound", this.speech.on);
    };
    const edges = () => {
      this.stage?.setEdges(!this.stage.edges);
      this.press("wireframe", Boolean(this.stage?.edges));
    };
    find("sound").addEventListener("click", () => sound().catch(report));
    find("wireframe").addEventListener("click", edges);
    find("reset").addEventListener("click", () => this.stage?.camera.reset());
    const actions = {
      "+": (camera) => camera.magnify(1.15),
      "-": (camera) => camera.magnify(1 / 1.15),
      a: (camera) => camera.turn(-0.1, 0),
      d: (camera) => camera.turn(0.1, 0),
      w: (camera) => camera.turn(0, 0.1),
      s: (camera) => camera.turn(0, -0.1),
      r: (camera) => camera.reset(),
      e: edges,
      m: () => find("sound").hidden || find("sound").click(),
      "?": () => find("keys").showModal(),
    };
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]") || !this.stage) return;
      const action = actions[event.key.toLowerCase()];
      if (!action) return;
      event.preventDefault();
      action(this.stage.camera);
    });
  }
}

connectDialogs();
const livePage = new LivePage();
livePage.controls();
// What scripts and tests may use.
window.facediff = {
  errors,
  get ready() { return Boolean(livePage.stage); },
  get connections() { return livePage.connections; },
  get stats() { return { ...livePage.stats, shown: livePage.stage?.shown ?? 0 }; },
  get speech() {
    const { speech } = livePage;
    if (!speech) return null;
    const { on, played, anchors, delay, planned, context, drawn, hold } = speech, now = performance.now() / 1000;
    const heard = context ? speech.heard(now) : null, ahead = speech.ahead(now);
    return { on, played, anchors, delay, planned, drawn, hold, now, heard, ahead, sounding: context?.currentTime ?? null };
  },
  get positions() { return livePage.stage?.face.positions; },
  get state() { return find("state").textContent; },
};
