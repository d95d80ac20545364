// The random numbers of facediff.runtime.noise, which are PyTorch's on a processor: equal seeds give equal motion.

/** Whole numbers of 32 bits (Matsumoto and Nishimura 1998), seeded by its authors' first rule. */
class MersenneTwister {
  constructor(seed) {
    this.state = new Uint32Array(624);
    this.state[0] = seed;
    for (let i = 1; i < 624; i++) {
      const before = this.state[i - 1] ^ (this.state[i - 1] >>> 30);
      this.state[i] = Math.imul(1812433253, before) + i;
    }
    this.at = 624;
  }

  next() {
    if (this.at === 624) this.twist();
    let value = this.state[this.at++];
    value ^= value >>> 11;
    value ^= (value << 7) & 0x9d2c5680;
    value ^= (value << 15) & 0xefc60000;
    return (value ^ (value >>> 18)) >>> 0;
  }

  twist() {
    const { state } = this;
    for (let i = 0; i < 624; i++) {
      const mixed = (state[i] & 0x80000000) | (state[(i + 1) % 624] & 0x7fffffff);
      state[i] = state[(i + 397) % 624] ^ (mixed >>> 1) ^ (mixed & 1 ? 0x9908b0df : 0);
    }
    this.at = 0;
  }
}

const NOISE_BLOCK = 16; // 16 normal numbers are made of 16 uniform ones: 8 radii and 8 angles

/** Unit Gaussian numbers. */
class NormalStream {
  constructor(seed) {
    this.bits = new MersenneTwister(seed);
  }

  /** The next numbers, 16 at least. */
  draw(count) {
    if (count < NOISE_BLOCK) throw new Error(`noise of ${count} numbers: a model with fewer than ${NOISE_BLOCK} cannot run in a page`);
    const uniform = this.uniform(count), made = new Float32Array(count);
    const whole = count - (count % NOISE_BLOCK);
    for (let at = 0; at < whole; at += NOISE_BLOCK) boxMuller(uniform, at, made, at);
    // What is left over is not drawn by itself: the last 16 numbers are drawn again.
    if (whole < count) boxMuller(this.uniform(NOISE_BLOCK), 0, made, count - NOISE_BLOCK);
    return made;
  }

  uniform(count) {
    const made = new Float32Array(count);
    for (let i = 0; i < count; i++) made[i] = (this.bits.next() & 0xffffff) * 2 ** -24;
    return made;
  }
}

/** 16 normal numbers of 16 uniform ones in [0, 1) (Box and Muller 1958). */
function boxMuller(uniform, from, made, to) {
  for (let i = 0; i < 8; i++) {
    const radius = Math.sqrt(-2 * Math.log(Math.fround(1 - uniform[from + i])));
    const angle = Math.fround(Math.fround(2 * Math.PI) * uniform[from + 8 + i]);
    made[to + i] = radius * Math.cos(angle);
    made[to + 8 + i] = radius * Math.sin(angle);
  }
}

/** The stream of a name and a seed. */
function streamOf(name, seed) {
  const sum = (~crcOf(new TextEncoder().encode(name), -1) >>> 0) + seed;
  return new NormalStream(sum % 2 ** 32);
}

/** Noise of a whole clip. */
class ClipNoise {
  constructor(name, seed) {
    this.stream = streamOf(name, seed);
  }

  /** The next noise (frames · width). */
  draw(frames, width) {
    return this.stream.draw(frames * width);
  }
}

/** Noise of a clip that depends on the seed alone, as the published methods draw it. */
class SeedNoise {
  constructor(seed) {
    this.stream = new NormalStream(seed % 2 ** 32);
  }

  /** The next noise (frames · width). */
  draw(frames, width) {
    return this.stream.draw(frames * width);
  }
}

const FIRST_DRAWS = 128;
const firstDraws = new Map(); // the latest come last

/** The first numbers of a stream: windows of low latency see those of some thirty windows before them again. */
function firstDraw(name, seed, count) {
  const key = `${name} ${seed} ${count}`, made = firstDraws.get(key) ?? streamOf(name, seed).draw(count);
  firstDraws.delete(key);
  firstDraws.set(key, made);
  if (firstDraws.size > FIRST_DRAWS) firstDraws.delete(firstDraws.keys().next().value);
  return made;
}

/** Noise of a window of long speech; frames that several windows have are given the same noise in all of them. */
class WindowNoise {
  constructor(name, window, seed) {
    Object.assign(this, { window, seed, origins: window.origins });
    this.names = this.origins.map(([index]) => `${name}/${index}`);
    this.streams = null; // of a sampler that draws more than once
    this.drawn = false;
  }

  /** The next noise (frames · width) of the window's frames. */
  draw(frames, width) {
    const { window: { plan }, names, origins, seed } = this, made = new Float32Array(frames * width);
    const counts = origins.map(([index]) => (index ? plan.hop : plan.frames) * width);
    const again = this.drawn;
    if (again && !this.streams) {
      this.streams = names.map((name) => streamOf(name, seed));
      this.streams.forEach((stream, i) => stream.draw(counts[i])); // what the first call gave
    }
    this.drawn = true;
    let at = 0;
    for (const [i, [, from, to]] of origins.entries()) {
      const drawn = again ? this.streams[i].draw(counts[i]) : firstDraw(names[i], seed, counts[i]);
      made.set(drawn.subarray(from * width, to * width), at);
      at += (to - from) * width;
    }
    return made;
  }
}
