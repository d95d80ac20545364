// An exported model at work: its folder, checked, and the path from samples to vertices, as facediff.runtime takes it.

const MODEL_FORMAT = "facediff model", MODEL_VERSION = 1;
/** Graphs that every folder has, by the kind of generation, and those that some have besides. */
const NEEDED = { sampled: ["speech", "step", "motion"], direct: ["speech", "motion"] };
const OPTIONAL = { sampled: ["start", "style"], direct: ["style"] };
/** What a description says where a folder was written before there was a choice. */
const EARLIER = { generation: "sampled", blending: "steps", clock: { rule: "rounded" }, style_source: "reference", longest: 0, drawn: 0, noise_of: "clip", usual_expressivity: 1, quick_steps: [], quick_table: [] };
const MOST_DESCRIPTION = 20e6, MOST_GRAPH = 2e9; // bytes

/** Let messages in: what computes for long can be cancelled then. */
const pause = () => new Promise((resolve) => {
  const { port1, port2 } = new MessageChannel();
  port1.onmessage = () => {
    port1.close();
    resolve();
  };
  port2.postMessage(null);
});

/** A file of the folder, of exactly `size` bytes if that is given. Args: also what hears how many bytes have come. */
async function fetchBytes(base, name, size, most, onBytes = () => {}) {
  const response = await fetch(new URL(name, base), { credentials: "omit" });
  if (!response.ok) throw new Error(`${name}: the server answers ${response.status}; put the exported model next to the page again`);
  const wrong = (count) => new Error(`${name}: has ${count} bytes, expected ${size}; copy or export the model again`);
  const reader = response.body.getReader(), parts = [];
  let count = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    count += value.length;
    if (count > (size ?? most)) {
      await reader.cancel();
      throw size === undefined ? new Error(`${name}: is larger than a page can hold`) : wrong(`more than ${size}`);
    }
    parts.push(value);
    onBytes(value.length);
  }
  if (size !== undefined && count !== size) throw wrong(count);
  return new Blob(parts).arrayBuffer();
}

/** Refuse a description that cannot be, as facediff.runtime.folder does. */
function checkDescription(about) {
  const refuse = (name, expected) => {
    throw new Error(`model.json: ${name} is ${String(JSON.stringify(about?.[name])).slice(0, 40)}, expected ${expected}; export the model again`);
  };
  if (about?.format !== MODEL_FORMAT) throw new Error("model.json: does not describe a model; put the folder that facediff export-model wrote next to the page");
  if (about.version !== MODEL_VERSION) refuse("version", MODEL_VERSION);
  const within = (value, least, most) => typeof value === "number" && value >= least && value <= most;
  const whole = (value, least, most) => Number.isInteger(value) && within(value, least, most);
  if (about.sample_rate !== SAMPLE_RATE) refuse("sample_rate", SAMPLE_RATE);
  if (!within(about.frame_rate, 1, 1000)) refuse("frame_rate", "1 to 1000");
  if (!(within(about.epsilon, 0, 1) && about.epsilon > 0 && about.epsilon < 1)) refuse("epsilon", "more than 0, less than 1");
  const words = { generation: Object.keys(NEEDED), blending: ["steps", "motion"], style_source: ["reference", "identity", "none"], noise_of: ["clip", "seed"] };
  for (const [name, known] of Object.entries(words)) if (!known.includes(about[name])) refuse(name, known.join(" or "));
  const sampled = about.generation === "sampled", needed = NEEDED[about.generation];
  const graphs = Object.keys(about.graphs ?? {}), known = [...needed, ...OPTIONAL[about.generation]];
  if (!needed.every((each) => graphs.includes(each)) || !graphs.every((each) => known.includes(each))) refuse("graphs", needed.join(", "));
  for (const [name, least] of [["state", 1], ["kept", 1], ["drawn", 0], ["longest", 0]]) {
    if (!whole(about[name], sampled ? least : 0, 1e7)) refuse(name, `${least} to 10000000`);
  }
  const names = (value) => Array.isArray(value) && value.every((each) => typeof each === "string");
  for (const name of ["identities", "faces", "styles"]) if (!names(about[name])) refuse(name, "names");
  for (const name of about.style_source === "reference" ? ["faces", "styles"] : ["faces"]) if (!about[name].length) refuse(name, "one name at least");
  const row = (each) => Array.isArray(each) && [5, 6].includes(each.length) && each.every(Number.isFinite);
  for (const [named, tabled, least] of [["steps", "table", sampled ? 1 : 0], ["quick_steps", "quick_table", 0]]) {
    const steps = about[named], table = about[tabled];
    if (!Array.isArray(steps) || !within(steps.length, least, 100_000) || !steps.every((each) => whole(each, 0, 2 ** 31))) refuse(named, "steps of the noise process");
    if (!Array.isArray(table) || table.length !== steps.length || !table.every(row)) refuse(tabled, "five or six numbers for each step");
  }
  if (!whole(about.last_step, -1, 2 ** 31)) refuse("last_step", "a step of the noise process");
  if (!["sample", "kept"].includes(about.decoded)) refuse("decoded", "sample or kept");
  for (const name of ["windows", "sizes", "licences"]) if (typeof about[name] !== "object" || !about[name]) refuse(name, "an object");
  const { rule, rows = 1, convolutions = [] } = about.clock ?? {};
  const layer = (each) => Array.isArray(each) && each.length === 2 && each.every((value) => whole(value, 1, 10_000));
  if (!CLOCK_RULES.includes(rule) || !whole(rows, 1, 1000) || !Array.isArray(convolutions) || convolutions.length > 64 || !convolutions.every(layer)) {
    refuse("clock", "a known rule with rows and convolutions");
  }
  const { seconds, overlap, before, after, above, past = 0 } = about.windows;
  const long = (value) => within(value, 0, 600);
  if (!long(seconds) || !long(overlap) || !long(before) || !long(after) || !long(past) || !within(above, 0, Infinity) || !(past ? overlap < seconds : overlap > 0 && overlap <= seconds / 2)) {
    refuse("windows", "possible lengths");
  }
  inFrames(about.windows, about.frame_rate);
  for (const name of [...loadedGraphs(about).map((graph) => `${graph}.onnx`), "arrays.npz"]) {
    if (!whole(about.sizes[name], 1, MOST_GRAPH)) refuse("sizes", `the bytes of ${name}`);
  }
}

/** The graphs that a page loads: it takes styles by their names, so that what encodes them from motion stays away. */
const loadedGraphs = ({ graphs }) => Object.keys(graphs).filter((graph) => graph !== "style");

/** Refuse arrays that do not fit the description, as facediff.runtime.folder does. */
function checkArrays(about, arrays) {
  const vertices = arrays.templates?.shape[1];
  const need = (name, shape, floating) => {
    const found = arrays[name];
    const fits = found && found.shape.length === shape.length && found.shape.every((size, axis) => shape[axis] === null || size === shape[axis]);
    if (!fits || (floating !== null && (found.data instanceof Float32Array) !== floating)) {
      throw new Error(`arrays.npz: ${name} ${found ? `has the shape ${found.shape}` : "is missing"}; export the model again`);
    }
    if (floating && !found.data.every(Number.isFinite)) throw new Error(`arrays.npz: ${name} holds numbers that are not finite; export the model again`);
  };
  need("templates", [about.faces.length, null, 3], true);
  if (about.style_source === "reference") need("styles", [about.styles.length, null], true);
  need("rest_weights", [about.faces.length, vertices], true);
  if (arrays.noise) need("noise", [about.state, about.state], true);
  if (!arrays.faces) throw new Error("arrays.npz: has no triangles (faces), which a picture needs; export a model whose corpus has a mesh");
  need("faces", [null, 3], false);
  if (arrays.colours) need("colours", arrays.colours.shape.length === 3 ? [about.faces.length, vertices, 3] : [vertices, 3], null);
  if (arrays.inner_lip_pairs) need("inner_lip_pairs", [null, 2], null);
  for (const [name, { data }] of Object.entries(arrays)) {
    if (!name.startsWith("region_") && !["faces", "inner_lip_pairs"].includes(name)) continue;
    if (!data.every((index) => index >= 0 && index < vertices)) throw new Error(`arrays.npz: ${name} names vertices that do not exist; export the model again`);
  }
}

/** A model that `facediff export-model` wrote, on ONNX Runtime's web build. */
class ExportedModel {
  constructor(ort, about, arrays, sessions) {
    Object.assign(this, { ort, about, arrays, sessions });
    this.vertices = arrays.templates.shape[1];
    this.size = 3 * this.vertices;
    this.clock = new FrameClock(about.frame_rate, about.clock);
    this.hurry(false);
  }

  /** A folder's description and arrays, which are enough to show a face. Args: the folder's address. */
  static async read(base) {
    const text = await fetchBytes(base, "model.json", undefined, MOST_DESCRIPTION);
    let about;
    try {
      about = { ...EARLIER, ...JSON.parse(new TextDecoder().decode(text)) };
    } catch {
      throw new Error("model.json: is no JSON; export the model again");
    }
    checkDescription(about);
    const arrays = await readArrays(await fetchBytes(base, "arrays.npz", about.sizes["arrays.npz"], MOST_GRAPH), "arrays.npz");
    checkArrays(about, arrays);
    return { about, arrays };
  }

  /** Args: ONNX Runtime; the folder's address, and what was read of it; what computes, by its names; what hears a share of all bytes. */
  static async open(ort, base, { about, arrays }, providers, onProgress) {
    const total = loadedGraphs(about).reduce((sum, graph) => sum + about.sizes[`${graph}.onnx`], 0);
    let come = 0;
    const onBytes = (count) => onProgress((come += count) / total);
    const sessions = {};
    for (const graph of loadedGraphs(about)) {
      const name = `${graph}.onnx`;
      const bytes = new Uint8Array(await fetchBytes(base, name, about.sizes[name], MOST_GRAPH, onBytes));
      try {
        sessions[graph] = await ort.InferenceSession.create(bytes, { executionProviders: providers, logSeverityLevel: 3 });
      } catch (error) {
        throw new Error(`${name}: ONNX Runtime cannot read it (${String(error.message ?? error).slice(0, 120)}); export the model again`);
      }
    }
    return new ExportedModel(ort, about, arrays, sessions);
  }

  /** Visit few denoising steps from now on, for low latency, or as many as usual. */
  hurry(on) {
    const { steps, table, quick_steps: few, quick_table: ofFew } = this.about;
    const [visited, rows] = on && few.length ? [few, ofFew] : [steps, table];
    this.loop = visited.map((step, at) => [step, rows[at]]);
  }

  /** What motion is conditioned on besides speech. Args: names and numbers, which may be absent. */
  conditions({ identity, condition, style, seed = 0, expressivity = this.about.usual_expressivity }) {
    const { about, arrays } = this;
    const chosen = identity ?? about.identities.find((name) => about.faces.includes(name)) ?? about.faces[0];
    const known = (what, name, names) => {
      if (!names.includes(name)) throw new Error(`${what}: there is no "${name}"; choose one of the list`);
      return names.indexOf(name);
    };
    const face = known("identity", chosen, about.faces);
    if (condition !== undefined) known("condition", condition, about.identities);
    const who = condition ?? chosen;
    if (style !== undefined && about.style_source === "none") throw new Error(`style: ${about.model} knows no speaking styles`);
    // Where the model's identities are its styles, the one that it is conditioned on is the style.
    const name = style ?? (about.style_source === "reference" ? chosen : who), width = arrays.styles?.shape[1];
    const row = about.style_source === "reference" || style !== undefined ? known("style", name, about.styles) : -1;
    if (!Number.isSafeInteger(seed) || seed < 0 || seed > 2 ** 32 - 1) throw new Error(`seed ${seed}: expected a whole number from 0 to ${2 ** 32 - 1}`);
    if (!(expressivity >= 0 && expressivity <= 2)) throw new Error(`expressivity ${expressivity}: expected 0 to 2`);
    if (expressivity !== 1 && about.last_step < 0) throw new Error(`expressivity: ${about.model} predicts no mean of its motion; choose 1`);
    return {
      face,
      identity: about.identities.indexOf(about.style_source === "identity" && style !== undefined ? style : who),
      style: about.style_source === "reference" ? arrays.styles.data.slice(row * width, (row + 1) * width) : new Float32Array(0),
      template: arrays.templates.data.slice(face * this.size, (face + 1) * this.size),
      names: { identity: chosen, ...(about.style_source === "none" ? {} : { style: name }) },
      seed,
      expressivity,
    };
  }

  /** Results of a graph in their order, { data, shape }; it may have no use for some of the inputs. */
  async run(graph, inputs) {
    const session = this.sessions[graph], feeds = {};
    for (const name of session.inputNames) feeds[name] = new this.ort.Tensor(...inputs[name]);
    const results = await session.run(feeds), found = [];
    for (const name of session.outputNames) {
      found.push({ data: await results[name].getData(), shape: [...results[name].dims] });
      results[name].dispose();
    }
    return found;
  }

  /** How many frames the model gives for speech, at least 1; its own number where it counts by itself. */
  ownFrames({ speech, frames }) {
    const own = this.clock.rule === "rounded" ? frames : Math.max(1, this.clock.frames(speech.length));
    const { longest, frame_rate: rate, model } = this.about;
    if (longest && own > longest) throw new Error(`the recording: ${model} was made for ${(longest / rate).toFixed(1)} s at most in one pass; open a shorter one`);
    return own;
  }

  /** Speech to features: { data, shape }. */
  async features({ speech, mean, deviation }, frames) {
    const found = await this.run("speech", {
      audio: ["float32", speech, [1, speech.length]],
      mean: ["float32", Float32Array.of(mean), [1]],
      deviation: ["float32", Float32Array.of(deviation), [1]],
      samples: ["int64", BigInt64Array.of(BigInt(speech.length)), [1]],
      mask: ["bool", new Uint8Array(frames).fill(1), [1, frames]],
    });
    return found[0];
  }

  /** Offsets (frames · 3 V) of a whole recording in one pass. */
  async clip(samples, frames, conditions, check) {
    const length = this.clock.rule === "rounded" ? samplesFor(frames, this.about.frame_rate) : samples.length;
    const speech = new Float32Array(length);
    speech.set(samples.subarray(0, length));
    const level = new Level();
    level.hear(speech);
    let squares = 0;
    for (const value of speech) squares += (value - level.mean) ** 2;
    const deviation = Math.sqrt(squares / length + this.about.epsilon);
    return clipMotion(this, { speech, frames, mean: level.mean, deviation }, conditions, check);
  }

  /** Windows that animate speech in pieces. Args: the conditions; the plan in frames; what throws when it is cancelled. */
  stream(conditions, plan, check) {
    let before = null; // what a window hands over to the next one
    const generate = async (window, speech, frames, mean, deviation) => {
      const found = await windowMotion(this, { speech, frames, mean, deviation }, window, conditions, before, check);
      before = found.kept;
      return found.motion;
    };
    return new SpeechWindows(plan, this.about.frame_rate, generate, this.size);
  }
}
