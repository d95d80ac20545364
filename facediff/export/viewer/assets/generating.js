// What generates the motion of an exported model: its graphs, and the sampler's table of numbers; see facediff.runtime.sampling.

/** What a clip is called where its noise is drawn. */
const CLIP_NAME = "speech";

/** Offsets (frames · 3 V) of a clip. Args: { speech, frames, mean, deviation }; what throws when it is cancelled. */
async function clipMotion(model, heard, conditions, check) {
  const { about, size } = model;
  await check();
  const own = model.ownFrames(heard), features = await model.features(heard, own);
  let made;
  if (about.generation === "direct") {
    made = (await model.run("motion", { features: ["float32", features.data, features.shape], ...conditioned(features, conditions) }))[0].data;
  } else {
    const noise = about.noise_of === "seed" ? new SeedNoise(conditions.seed) : new ClipNoise(CLIP_NAME, conditions.seed);
    made = await new Sampling(model, conditions, features, null, null, check).run(noise, new ClipNoise(`${CLIP_NAME}/mean`, 0));
  }
  const given = made.length / size;
  if (given === heard.frames) return made;
  // A model that counts its frames by itself may give fewer than the speech lasts: its last one is held.
  const whole = new Float32Array(heard.frames * size);
  for (let frame = 0; frame < heard.frames; frame++) {
    const from = Math.min(frame, given - 1);
    whole.set(made.subarray(from * size, (from + 1) * size), frame * size);
  }
  return whole;
}

/** Motion of a window but for its past, and what the next window is given of it: { motion, kept }. */
async function windowMotion(model, heard, window, conditions, before, check) {
  const { about, size } = model, { context, frames } = window;
  if (about.blending === "motion") {
    const all = await clipMotion(model, heard, conditions, check);
    const motion = all.slice((context + window.fixed) * size, (context + frames) * size);
    if (before) {
      const shared = before[0].length / size;
      for (let frame = 0; frame < shared; frame++) {
        const share = crossfade(frame, shared, 0);
        for (let i = frame * size; i < (frame + 1) * size; i++) motion[i] = before[0][i] + share * (motion[i] - before[0][i]);
      }
    }
    return { motion, kept: [lastOf(motion, window.plan.overlap * size)] };
  }
  const { data, shape } = await model.features(heard, heard.frames);
  const width = data.length / heard.frames;
  const count = frames + window.plan.ahead, latest = frames + window.plan.after - 1;
  const features = { data: data.slice(context * width, (context + count) * width), shape: [1, count, ...shape.slice(2)] };
  // Speech that is not heard yet is taken to stay as it is heard last.
  for (let frame = latest + 1; frame < count; frame++) {
    features.data.copyWithin(frame * width, latest * width, (latest + 1) * width);
  }
  const sampling = new Sampling(model, conditions, features, before, window, check);
  const noise = new WindowNoise(CLIP_NAME, window, conditions.seed);
  const motion = await sampling.run(noise, new WindowNoise(`${CLIP_NAME}/mean`, window, 0));
  return { motion, kept: sampling.kept.map((each) => lastOf(each.subarray(0, frames * about.kept), window.kept * about.kept)) };
}

/** What every graph after the first is given; each takes what it has a use for. */
function conditioned(features, { identity, style, template }) {
  return {
    mask: ["bool", new Uint8Array(features.shape[1]).fill(1), [1, features.shape[1]]],
    identity: ["int64", BigInt64Array.of(BigInt(identity)), [1]],
    style: ["float32", style, [1, style.length]],
    template: ["float32", template, [1, template.length / 3, 3]],
  };
}

/** The last numbers of an array; there may be fewer. */
const lastOf = (array, count) => array.slice(Math.max(0, array.length - count));

/** The new window's share in a shared frame: 0 up to the first one that may change, smooth at both ends. */
function crossfade(frame, shared, fixed) {
  const place = Math.max(frame - fixed, 0) / Math.max(1, shared - fixed);
  return place * place * (3 - 2 * place);
}

/** One run of the sampler, of a clip or of a window that continues another. */
class Sampling {
  constructor(model, conditions, features, before, window, check) {
    Object.assign(this, { model, conditions, features, before, window, check });
    this.frames = features.shape[1];
    this.kept = []; // what the next window is blended with, one array for each evaluation
  }

  /** Offsets from the template (frames · 3 V), but for those frames that are given out already. */
  async run(noise, ofMean) {
    const { about } = this.model, share = this.conditions.expressivity, width = about.drawn || about.state;
    let mean = null;
    if (share !== 1) {
      // The model's own mean: the prediction at the last step, averaged over a noise and its negative.
      const unit = ofMean.draw(this.frames, width), ends = [];
      for (const each of [unit, unit.map((value) => -value)]) {
        ends.push(await this.decoded(await this.evaluate(await this.start(each), about.last_step), each));
      }
      mean = ends[0].map((value, i) => 0.5 * (value + ends[1][i]));
      if (share === 0) return mean;
    }
    const unit = noise.draw(this.frames, width);
    const motion = await this.decoded(await this.loop(await this.start(unit), noise), unit);
    if (mean) for (let i = 0; i < motion.length; i++) motion[i] = mean[i] + share * (motion[i] - mean[i]);
    return motion;
  }

  /** The sampler's result, and what was kept of the last step. */
  async loop(noisy, noise) {
    const { loop, about: { state } } = this.model;
    let sample = noisy, predictions = [], kept = noisy, earliest = null;
    for (const [step, [ofSample, first, second, third, ofNoise, ofFirst = 0]] of loop) {
      const found = await this.evaluate(sample, step);
      predictions = [found.prediction, ...predictions].slice(0, 3);
      earliest ??= found.prediction;
      kept = found.kept;
      const made = sample.map((value) => ofSample * value);
      for (const [factor, prediction] of [[first, predictions[0]], [second, predictions[1]], [third, predictions[2]], [ofFirst, earliest]]) {
        if (factor && prediction) prediction.forEach((value, i) => (made[i] += factor * value));
      }
      if (ofNoise) this.coloured(noise.draw(this.frames, state)).forEach((value, i) => (made[i] += ofNoise * value));
      sample = made;
    }
    return { prediction: sample, kept };
  }

  /** The network's prediction at a step, blended with that of the window before. */
  async evaluate(sample, step) {
    await this.check();
    const { model, frames, features } = this, { about } = model;
    const before = new Float32Array(frames * about.kept), share = new Float32Array(frames).fill(1);
    if (this.before) {
      const { shared, fixed } = this.window;
      before.set(this.before[this.kept.length]);
      for (let frame = 0; frame < shared; frame++) share[frame] = crossfade(frame, shared, fixed);
    }
    const [prediction, kept] = await model.run("step", {
      features: ["float32", features.data, features.shape],
      ...conditioned(features, this.conditions),
      state: ["float32", sample, [1, frames, about.state]],
      step: ["int64", BigInt64Array.of(BigInt(step)), [1]],
      before: ["float32", before, [1, frames, about.kept]],
      share: ["float32", share, [1, frames]],
    });
    this.kept.push(kept.data);
    return { prediction: prediction.data, kept: kept.data };
  }

  async decoded({ prediction, kept }, unit) {
    const { model, frames } = this, last = model.about.decoded === "kept" ? kept : prediction;
    const { fixed, frames: end } = this.window ?? { fixed: 0, frames };
    const shaped = (values) => {
      const width = values.length / frames;
      return ["float32", values.subarray(fixed * width, end * width), [1, end - fixed, width]];
    };
    return (await model.run("motion", { sample: shaped(last), noise: shaped(unit) }))[0].data;
  }

  /** The noisy motion that the loop starts from. */
  async start(unit) {
    if (!("start" in this.model.sessions)) return this.coloured(unit);
    return (await this.model.run("start", { noise: ["float32", unit, [1, this.frames, unit.length / this.frames]] }))[0].data;
  }

  /** Noise (frames · state) with the model's covariance. */
  coloured(unit) {
    const root = this.model.arrays.noise?.data, width = this.model.about.state;
    if (!root) return unit;
    const made = new Float32Array(unit.length);
    for (let row = 0; row < unit.length; row += width) {
      for (let k = 0; k < width; k++) {
        const value = unit[row + k];
        for (let column = 0; column < width; column++) made[row + column] += value * root[k * width + column];
      }
    }
    return made;
  }
}
