// The worker of the talking page: it loads the model, hears samples, and answers with motion, so that the page stays smooth.

const CANCELLED = "cancelled";
let model = null; // once it is loaded
let listening = null; // the stream of a microphone
const cancelled = new Set(); // jobs that nobody waits for any more

/** Throws if a job was cancelled, after letting messages in. */
const checking = (id) => async () => {
  await pause();
  if (cancelled.has(id)) throw new Error(CANCELLED);
};

/** Give frames to the page, with the mouth as far at rest as the gate says; what waits for the gate is kept. */
class Outlet {
  constructor(id, conditions, gate) {
    this.id = id;
    this.weights = model.arrays.rest_weights.data.slice(conditions.face * model.vertices, (conditions.face + 1) * model.vertices);
    this.gate = gate ? new Openness(gate, model.about.frame_rate) : null;
    this.open = []; // of frames that wait for their motion
    this.waiting = []; // motion that waits for the gate, frame by frame
    this.given = 0;
  }

  /** The gate hears what the model hears. */
  hear(samples) {
    if (this.gate) this.open.push(...this.gate.feed(samples));
  }

  /** Parts of motion that are certain; at the end, the number of all frames. */
  give(parts, total) {
    for (const part of parts) {
      for (let at = 0; at < part.length; at += model.size) this.waiting.push(part.subarray(at, at + model.size));
    }
    if (this.gate && total !== undefined) this.open.push(...this.gate.finish(total));
    const count = this.gate ? Math.min(this.waiting.length, this.open.length) : this.waiting.length;
    if (!count) return;
    const offsets = new Float32Array(count * model.size);
    this.waiting.splice(0, count).forEach((frame, number) => offsets.set(frame, number * model.size));
    if (this.gate) towardRest(offsets, this.open.splice(0, count), this.weights);
    postMessage({ kind: "frames", id: this.id, start: this.given, count, offsets }, [offsets.buffer]);
    this.given += count;
  }
}

const actions = {
  /** Load ONNX Runtime and the model. */
  async open({ id, base, runtime, device, threads }) {
    const face = await ExportedModel.read(base);
    postMessage({ kind: "face", id, ...face });
    const ort = await import(new URL(device === "webgpu" ? "ort.webgpu.min.mjs" : "ort.wasm.min.mjs", runtime));
    Object.assign(ort.env.wasm, { wasmPaths: String(runtime), numThreads: threads, proxy: false });
    ort.env.logLevel = "error";
    const providers = device === "webgpu" ? ["webgpu", "wasm"] : ["wasm"];
    model = await ExportedModel.open(ort, base, face, providers, (share) => postMessage({ kind: "loading", id, share }));
    postMessage({ kind: "opened", id });
  },

  /** Animate a recording. Args: windows other than the model's, `quick` ones in few steps; a gate, or null. */
  async animate({ id, samples, choices, gate, windows }) {
    const conditions = model.conditions(choices), { about } = model;
    const outlet = new Outlet(id, conditions, gate), check = checking(id);
    model.hurry(windows?.quick);
    const frames = model.clock.frames(samples.length);
    if (frames < 1) throw new Error("the recording is shorter than one frame; choose a longer one");
    const plan = windows ?? about.windows;
    const began = performance.now();
    if (frames <= plan.above * about.frame_rate) {
      outlet.hear(samples);
      outlet.give([await model.clip(samples, frames, conditions, check)], frames);
    } else {
      const stream = model.stream(conditions, inFrames(plan, about.frame_rate), check);
      for (let at = 0; at < samples.length; at += SAMPLE_RATE) {
        const piece = samples.subarray(at, at + SAMPLE_RATE);
        outlet.hear(piece);
        outlet.give(await stream.feed(piece));
      }
      outlet.give(await stream.finish(frames), frames);
    }
    postMessage({ kind: "finished", id, frames, names: conditions.names, seconds: (performance.now() - began) / 1000 });
  },

  /** Begin to listen to a microphone. */
  async listen({ id, choices, gate, windows }) {
    model.hurry(windows.quick);
    const conditions = model.conditions(choices);
    const stream = model.stream(conditions, inFrames(windows, model.about.frame_rate), checking(id));
    listening = { id, stream, outlet: new Outlet(id, conditions, gate), heard: 0 };
  },

  /** More of the microphone's samples at 16 kHz. */
  async feed({ id, samples }) {
    if (listening?.id !== id) return;
    const { stream, outlet } = listening;
    outlet.hear(samples);
    outlet.give(await stream.feed(samples));
    listening.heard += samples.length;
    postMessage({ kind: "heard", id, samples: listening.heard });
  },

  /** The microphone is switched off. */
  async finish({ id }) {
    if (listening?.id === id) listening = null;
    postMessage({ kind: "finished", id });
  },
};

let last = Promise.resolve();
onmessage = ({ data }) => {
  if (data.kind === "cancel") {
    cancelled.add(data.id);
    return;
  }
  // One after the other: ONNX Runtime computes one graph at a time.
  last = last.then(async () => {
    try {
      if (!model && data.kind !== "open") throw new Error("the model is not loaded: choose what else computes, or load this page again");
      if (!cancelled.has(data.id)) await actions[data.kind](data);
    } catch (error) {
      if (error.message !== CANCELLED) postMessage({ kind: "failed", id: data.id, of: data.kind, message: String(error?.message ?? error) });
    }
  });
};
