// Keys over time: the channels that can be directed, their curves, files, and the history of changes. Nothing here draws.

const KINDS = ["step", "linear", "smooth"];
const SAME_TIME = 1e-6; // s
const LATEST = 86_400; // s
const MOST_SLOPE = 1e6; // a second
const FIELDS = ["format", "version", "instead_of", "keys"];
const COLUMNS = ["time", "channel", "value", "interpolation", "slope"];

/** Change a second at each key: as given, or else such that a smooth curve does not overshoot. */
function slopesOf(keys) {
  return keys.map(({ time, value, slope }, i) => {
    if (slope !== undefined) return slope;
    if (i === 0 || i === keys.length - 1) return 0;
    const before = (value - keys[i - 1].value) / (time - keys[i - 1].time);
    const after = (keys[i + 1].value - value) / (keys[i + 1].time - time);
    if (before * after <= 0) return 0;
    const middle = (keys[i + 1].value - keys[i - 1].value) / (keys[i + 1].time - keys[i - 1].time);
    return Math.sign(middle) * Math.min(Math.abs(middle), 3 * Math.min(Math.abs(before), Math.abs(after)));
  });
}

/** The key that is in force at a time: the last one that is not later, or the first of all. */
function placeOf(keys, time) {
  let place = 0, after = keys.length; // found by halving: curves are drawn pixel by pixel
  while (after - place > 1) {
    const middle = (place + after) >> 1;
    if (keys[middle].time <= time + 1e-9) place = middle;
    else after = middle;
  }
  return place;
}

/**
 * The number that a channel's keys (one or more, in order) give at a time. `easing` is what a step takes in seconds, just
 * before the key that it leads to; 0 for a jump. Whoever asks often gives the keys' slopes.
 */
function valueAt(keys, time, [least, most], easing = 0, slopes = null) {
  const place = placeOf(keys, time);
  const from = keys[place], to = keys[place + 1];
  if (!to || time <= from.time) return Math.max(least, Math.min(most, from.value));
  const span = to.time - from.time, change = to.value - from.value;
  let t = Math.min(1, (time - from.time) / span), found = from.value;
  if (from.interpolation === "linear") found += t * change;
  if (from.interpolation === "smooth") {
    slopes ??= slopesOf(keys);
    found += (3 * t * t - 2 * t ** 3) * change;
    found += span * ((t ** 3 - 2 * t * t + t) * slopes[place] + (t ** 3 - t * t) * slopes[place + 1]);
  }
  if (from.interpolation === "step" && easing) {
    t = Math.max(0, 1 - (to.time - time) / Math.min(span, easing));
    found += (3 * t * t - 2 * t ** 3) * change;
  }
  return Math.max(least, Math.min(most, found));
}

class Direction {
  /**
   * Args: what the page says about channels and the file; the keys as rows of a file; what is done after every change; the
   * options that the keys stand for.
   */
  constructor(facts, rows, onChange, turned = []) {
    Object.assign(this, { facts, onChange });
    this.keys = Object.assign(this.ordered(rows.map((row) => Object.freeze({ ...row }))), { turned });
    this.saved = this.keys;
    this.past = [];
    this.future = [];
    this.held = null;
  }

  /** What is known about a channel by its full name; undefined if there is no such channel. */
  channel(name) {
    const [first, ...rest] = name.split(".");
    const base = this.facts.channels[first];
    return this.facts.channels[name] ?? (base && base.regions && rest.join(".") ? base : undefined);
  }

  /** The keys of a channel in their order in time. */
  of(name) {
    return this.keys.filter(({ channel }) => channel === name);
  }

  get channels() {
    return [...new Set(this.keys.map(({ channel }) => channel))];
  }

  ordered(keys) {
    return keys.sort((a, b) => a.time - b.time);
  }

  /** The key of a channel at a time, other than one of them. */
  at(name, time, except) {
    return this.of(name).find((key) => key !== except && Math.abs(key.time - time) < SAME_TIME);
  }

  /** A channel's number at a time, or its text; without keys, where it rests. */
  value(name, time, easing) {
    const keys = this.of(name), { range, rest } = this.channel(name);
    if (!keys.length) return rest;
    return range ? valueAt(keys, time, range, easing) : keys[placeOf(keys, time)].value;
  }

  // Changes. Keys are never changed but replaced, so that the history is a list of lists.

  /** `turned` names the options, acting and blinks, that keys stand in place of; it is part of the history as they are. */
  set(keys, turned = this.keys.turned) {
    if (!this.held) {
      this.past.push(this.keys);
      this.future = [];
    }
    this.keys = Object.assign(this.ordered([...keys]), { turned });
    this.onChange();
  }

  /** Add a key and return it; at the time of another one, that one gets the value. */
  add(name, time, value = this.value(name, time)) {
    const there = this.at(name, time);
    if (there) return this.change(there, { value });
    const before = this.of(name).findLast((key) => key.time < time);
    const key = Object.freeze({ time, channel: name, value, interpolation: before ? before.interpolation : "smooth" });
    this.set([...this.keys, key]);
    return key;
  }

  /** Change a key and return what stands in its place; two keys of a channel never get one time. */
  change(key, changes) {
    const { range } = this.channel(key.channel);
    const changed = { ...key, ...changes };
    changed.time = Math.max(0, changed.time);
    if (range) changed.value = Math.max(range[0], Math.min(range[1], Number(changed.value.toFixed(4))));
    if (changed.slope === undefined || changed.slope === null) delete changed.slope;
    if (this.at(key.channel, changed.time, key)) changed.time = key.time;
    if (JSON.stringify(changed) === JSON.stringify(key)) return key;
    this.set(this.keys.map((each) => (each === key ? Object.freeze(changed) : each)));
    return this.keys.find((each) => each.channel === changed.channel && each.time === changed.time);
  }

  remove(keys) {
    this.set(this.keys.filter((key) => !keys.includes(key)));
  }

  /** Put rows in the place of keys, in one change, and return them as keys; null if two keys of a channel would meet. */
  replace(keys, rows) {
    const kept = this.keys.filter((key) => !keys.includes(key));
    const taken = ({ channel, time }) => kept.some((key) => key.channel === channel && Math.abs(key.time - time) < SAME_TIME);
    if (rows.some((row) => row.time < 0 || taken(row))) return null;
    const placed = rows.map((row) => {
      const { range } = this.channel(row.channel);
      const value = range ? Math.max(range[0], Math.min(range[1], Number(row.value.toFixed(4)))) : row.value;
      return Object.freeze({ ...row, value });
    });
    if (JSON.stringify(placed) !== JSON.stringify(keys)) this.set([...kept, ...placed]);
    else return keys;
    return placed;
  }

  removeChannel(name) {
    if (this.of(name).length) this.set(this.keys.filter(({ channel }) => channel !== name));
  }

  /** Changes from here to `release` are undone together, such as those of a drag. */
  hold() {
    this.held = this.keys;
  }

  release() {
    if (this.held && this.held !== this.keys) {
      this.past.push(this.held);
      this.future = [];
    }
    this.held = null;
    this.onChange();
  }

  undo() {
    this.travel(this.past, this.future);
  }

  redo() {
    this.travel(this.future, this.past);
  }

  travel(from, to) {
    if (!from.length || this.held) return;
    to.push(this.keys);
    this.keys = from.pop();
    this.onChange();
  }

  get unsaved() {
    return this.keys !== this.saved;
  }

  // Files.

  /** The content of a keys file, one key a line. */
  text() {
    const { format, version } = this.facts;
    const rows = this.keys.map((key) => `    ${JSON.stringify(key)}`).join(",\n");
    const { turned } = this.keys, instead = turned.length ? `\n  "instead_of": ${JSON.stringify(turned)},` : "";
    return `{\n  "format": ${JSON.stringify(format)},\n  "version": ${version},${instead}\n  "keys": [\n${rows}\n  ]\n}\n`;
  }

  /** Replace all keys by those of a file's content, in one change that can be undone. */
  open(text) {
    const read = JSON.parse(text), content = Array.isArray(read) ? { keys: read } : read, { facts } = this;
    if (!Array.isArray(content?.keys)) throw new Error('holds no list called "keys"');
    const other = Object.keys(content).find((key) => !FIELDS.includes(key));
    if (other !== undefined) throw new Error(`${other}: expected ${FIELDS.join(", ")}`);
    const { format = facts.format, version = facts.version, instead_of: turned = [], keys: rows } = content;
    if (format !== facts.format) throw new Error("is no keys file");
    if (version !== facts.version) throw new Error(`has version ${version}`);
    if (!Array.isArray(turned) || turned.some((name) => !facts.insteadOf.includes(name))) {
      throw new Error(`instead_of: expected a list of ${facts.insteadOf.join(", ")}`);
    }
    const keys = rows.map((row, i) => this.row(row, `row ${i + 1}`));
    const seen = new Set();
    keys.forEach(({ channel, time }, i) => {
      if (seen.has(`${time} ${channel}`)) throw new Error(`row ${i + 1}: ${channel} has a key at ${time} s already`);
      seen.add(`${time} ${channel}`);
    });
    this.set(keys, [...new Set(turned)]);
  }

  row(row, where) {
    const { channel, interpolation = "smooth" } = row ?? {};
    for (const name of Object.keys(row ?? {})) {
      if (!COLUMNS.includes(name)) throw new Error(`${where}: ${name}: expected ${COLUMNS.join(", ")}`);
    }
    const known = typeof channel === "string" && this.channel(channel);
    if (!known) throw new Error(`${where}: channel: ${channel} is not known`);
    const { range } = known, value = range ? numberOf(row.value) : row.value, slope = numberOf(row.slope ?? null);
    const fits = range ? typeof value === "number" && value >= range[0] && value <= range[1] : typeof value === "string" && value.trim();
    if (!fits) throw new Error(`${where}: value: expected ${range ? `${range[0]} to ${range[1]}` : "a text"}`);
    if (!KINDS.includes(interpolation)) throw new Error(`${where}: interpolation: expected ${KINDS.join(", ")}`);
    const time = numberOf(row.time);
    if (!(typeof time === "number" && time >= 0 && time <= LATEST)) throw new Error(`${where}: time: expected seconds up to a day`);
    if (slope !== null && !(range && Math.abs(slope) <= MOST_SLOPE && typeof slope === "number")) {
      throw new Error(`${where}: slope: expected ${range ? "a number" : "none, since this is a text"}`);
    }
    return Object.freeze({ time, channel, value, interpolation, ...(slope === null ? {} : { slope }) });
  }
}

/** The number that a text spells, as the command reads cells of a table; anything else as it is. */
function numberOf(value) {
  return typeof value === "string" && /^[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$/i.test(value) ? Number(value) : value;
}
