// One rater's way through the study: welcome, trials, last questions, thanks. Answers are stored in this browser after
// every step, and sent to the server of `facediff study serve` if there is one.
(() => {
"use strict";
const study = JSON.parse(document.getElementById("study").textContent);
const byId = (name) => document.getElementById(name);
const key = `facediff study ${study.id}`;
const choices = study.questions.filter((question) => question.kind === "choice");
const fields = study.questions.filter((question) => question.kind === "text");
const SEEN = 0.9; // share of a video that has to be played before it may be judged
const AGAIN = 3000; // milliseconds until the next try to send

let memory = null; // the state in this browser when its storage cannot be used
let hasServer = false;
let current = null; // the trial on the screen: {trial, since, plays, seen}
let isSending = false;
let retryTimer = null; // the timer of the next try to begin
const problems = [];
const warnings = new Set(); // names of the texts that warn

window.addEventListener("error", (event) => problems.push(event.message));
window.addEventListener("unhandledrejection", (event) => problems.push(String(event.reason)));

// State.

function random() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return [...bytes].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

function load() {
  if (memory) return memory;
  try {
    const found = JSON.parse(localStorage.getItem(key));
    if (found && found.study === study.id && /^[0-9a-f]{32}$/.test(found.rater)) memory = found;
  } catch { /* no storage, or damaged: begin again */ }
  if (!memory) {
    memory = {
      format: study.answers, study: study.id, rater: random(), number: null, language: null, code: "",
      started: null, finished: null, trials: [], comments: {}, sent: 0, closed: false,
    };
  }
  return memory;
}

function save() {
  try { localStorage.setItem(key, JSON.stringify(memory)); } catch { /* the state lives as long as the page */ }
}

function forget() {
  memory = null;
  try { localStorage.removeItem(key); } catch { /* there is none */ }
}

const now = () => new Date().toISOString();
const text = (name) => study.texts[load().language][name];
const schedule = () => study.schedules[load().number % study.schedules.length].map((index) => study.trials[index]);

// Server.

async function post(path, content) {
  const answer = await fetch(path, {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content),
  });
  if (!answer.ok) {
    const error = new Error(`${path}: ${answer.status}`);
    error.refused = [400, 409, 413].includes(answer.status); // again if repeated
    error.full = answer.status === 403;
    error.unknown = answer.status === 404; // the server does not know this rater
    throw error;
  }
  return answer.json();
}

async function findServer() {
  if (!location.protocol.startsWith("http")) return false;
  try {
    const answer = await fetch("api/study");
    return answer.ok && (await answer.json()).id === study.id;
  } catch { return false; }
}

// Sends unsent answers in order. The server keeps the first of equal submissions.
async function send() {
  if (!hasServer || isSending) return;
  isSending = true;
  const state = load();
  try {
    while (state.sent < state.trials.length) {
      await post("api/answers", { study: study.id, rater: state.rater, ...state.trials[state.sent] }).catch((error) => {
        if (!error.refused) throw error; // it stays in this browser, and the next one is sent
      });
      state.sent += 1;
      save();
    }
    if (state.finished && !state.closed) {
      await post("api/finish", { study: study.id, rater: state.rater, comments: state.comments }).then(
        () => { state.closed = true; },
        (error) => {
          if (!error.refused) throw error;
          hasServer = false; // the rater hands the file over
        },
      );
      save();
      show();
    }
    warn("waiting", false);
  } catch (error) {
    warn("waiting", !error.unknown);
    if (error.unknown) {
      hasServer = false; // the rater hands the file over
      if (!byId("thanks").hidden) showThanks();
    } else setTimeout(send, AGAIN);
  } finally { isSending = false; }
}

function warn(name, on = warnings.has(name)) {
  warnings[on ? "add" : "delete"](name);
  byId("status").hidden = !warnings.size;
  byId("status").textContent = [...warnings].map(text).join(" ");
}

// Display.

function translate() {
  const state = load();
  document.documentElement.lang = state.language;
  document.title = study.title[state.language];
  byId("title").textContent = study.title[state.language];
  byId("consent").textContent = study.consent[state.language];
  for (const name of ["how", "keys", "turn", "left", "right"]) byId(name).textContent = text(name);
  for (const name of ["agree", "code", "last", "thanks", "completion", "reference"]) {
    byId(`${name}-text`).textContent = text(name);
  }
  for (const name of ["next", "finish", "download", "restart"]) byId(name).textContent = text(name);
  byId("play-reference").textContent = text("play_reference");
  byId("start").textContent = text(state.number === null ? "start" : "resume");
  if (current) showQuestions();
  if (!byId("last").hidden) showFields();
  if (!byId("thanks").hidden) showThanks();
  warn("waiting");
  label();
}

function show() {
  const state = load();
  const done = state.number !== null ? state.trials.length : 0;
  const total = state.number !== null ? schedule().length : 0;
  let section = "welcome";
  if (state.number !== null && state.started && byId("welcome").dataset.left) {
    section = state.finished ? "thanks" : done < total ? "trial" : "last";
    if (section === "last" && !fields.length) return finish();
  }
  if (state.finished) section = "thanks";
  for (const name of ["welcome", "trial", "last", "thanks"]) byId(name).hidden = name !== section;
  translate();
  if (section === "trial") showTrial(schedule()[done], done, total);
  if (section === "last") (byId("fields").querySelector("textarea") || byId("finish")).focus();
  window.scrollTo(0, 0);
}

function showTrial(trial, done, total) {
  current = { trial, since: performance.now(), plays: 0, seen: false, given: {} };
  byId("progress").value = done / total;
  const asksForReference = trial.reference && choices.some((question) => question.reference);
  byId("reference-box").hidden = !asksForReference;
  byId("video").src = `videos/${trial.video}`;
  if (asksForReference) byId("reference").src = `videos/${trial.reference}`;
  else byId("reference").removeAttribute("src");
  showQuestions();
  preload(schedule()[done + 1]);
  byId("play").focus({ preventScroll: true });
}

function preload(trial) {
  if (!trial) return;
  const next = document.createElement("video");
  next.preload = "auto";
  next.muted = true;
  next.src = `videos/${trial.video}`;
  current.preloaded = next;
}

function showQuestions() {
  const asked = choices.filter((question) => !question.reference || current.trial.reference);
  current.asked = asked;
  byId("count").textContent = text("progress").replace("{n}", load().trials.length + 1).replace("{total}", schedule().length);
  byId("choices").replaceChildren(...asked.map((question) => {
    const group = document.createElement("fieldset");
    const legend = document.createElement("legend");
    legend.textContent = question.text[load().language];
    const options = document.createElement("div");
    options.className = "options";
    for (const answer of question.answers) {
      const line = document.createElement("label");
      const input = document.createElement("input");
      Object.assign(input, { type: "radio", name: question.name, value: answer });
      input.checked = current.given[question.name] === answer;
      input.addEventListener("change", () => give(question.name, answer));
      line.append(input, text(answer));
      options.append(line);
    }
    group.append(legend, options);
    return group;
  }));
  refresh();
}

function give(question, answer) {
  current.given[question] = answer;
  for (const input of byId("choices").querySelectorAll(`input[name="${question}"]`)) input.checked = input.value === answer;
  refresh();
}

function unanswered() {
  return current.asked.findIndex((question) => !Object.hasOwn(current.given, question.name));
}

function refresh() {
  const open = unanswered();
  [...byId("choices").children].forEach((group, index) => {
    group.disabled = !current.seen;
    group.classList.toggle("now", current.seen && index === open);
  });
  byId("next").disabled = !current.seen || open >= 0;
  byId("hint").textContent = !current.seen ? text("watch") : open >= 0 ? text("choose") : "";
  label();
}

function label() {
  if (!load().language) return;
  const video = byId("video");
  byId("play").textContent = text(!video.paused && !video.ended ? "pause" : current && current.seen ? "again" : "play");
}

function showFields() {
  current = null;
  byId("fields").replaceChildren(...fields.map((question) => {
    const line = document.createElement("label");
    line.className = "block";
    const words = document.createElement("span");
    words.textContent = `${question.text[load().language]} (${text("optional")})`;
    const area = document.createElement("textarea");
    area.maxLength = study.longest;
    area.name = question.name;
    area.value = Object.hasOwn(load().comments, question.name) ? load().comments[question.name] : "";
    area.addEventListener("input", () => { load().comments[question.name] = area.value; save(); });
    line.append(words, area);
    return line;
  }));
}

function answersFile() {
  const { sent, closed, ...content } = load();
  return JSON.stringify(content, null, 1);
}

let address = null;
function showThanks() {
  current = null;
  const state = load();
  byId("completion").textContent = state.rater.slice(0, 8).toUpperCase();
  const link = byId("download");
  link.hidden = hasServer && state.closed;
  byId("thanks-more").textContent = hasServer ? (state.closed ? text("stored") : "") : text("hand_over");
  if (address) URL.revokeObjectURL(address);
  address = URL.createObjectURL(new Blob([answersFile()], { type: "application/json" }));
  link.href = address;
  link.download = `answers-${study.id}-${state.rater.slice(0, 8)}.json`;
}

// Actions of the rater.

async function begin() {
  const state = load();
  clearTimeout(retryTimer);
  if (byId("welcome").dataset.left) return;
  byId("start").disabled = true;
  try {
    if (state.number === null) {
      state.code = byId("code").value.trim();
      if (hasServer) {
        const { rater, language, code } = state;
        state.number = (await post("api/raters", { study: study.id, rater, language, code, agreed: true })).number;
      } else {
        const wanted = /[?&#]rater=(\d{1,9})\b/.exec(location.search + location.hash);
        const [any] = crypto.getRandomValues(new Uint32Array(1));
        state.number = wanted ? Number(wanted[1]) : any % study.schedules.length;
      }
      state.started = now();
      save();
    }
    byId("welcome").dataset.left = "yes";
    warn("waiting", false);
    warn("refused", false);
    show();
  } catch (error) {
    const final = error.refused || error.full || error.unknown;
    warn("waiting", !final);
    warn("refused", final);
    if (final) setTimeout(() => { byId("start").disabled = !byId("agree").checked; }, 500); // with another code it may do
    else retryTimer = setTimeout(() => { if (byId("agree").checked) begin(); }, AGAIN);
  }
}

function next() {
  if (!current || !current.seen || unanswered() >= 0) return;
  const state = load();
  state.trials.push({
    trial: current.trial.id, answers: current.given, plays: current.plays, at: now(),
    seconds: Math.round((performance.now() - current.since) / 10) / 100,
  });
  current = null; // a second click finds nothing to submit
  save();
  send();
  show();
}

function finish() {
  const state = load();
  if (!state.finished) {
    state.finished = now();
    save();
  }
  send();
  show();
}

function play(element) {
  const other = element === byId("video") ? byId("reference") : byId("video");
  other.pause();
  if (element.paused || element.ended) {
    if (element.ended) element.currentTime = 0;
    element.play().catch(() => {});
  } else element.pause();
}

function watched() {
  const video = byId("video");
  if (!current || current.seen || !Number.isFinite(video.duration)) return;
  let seconds = 0;
  for (let i = 0; i < video.played.length; i += 1) seconds += video.played.end(i) - video.played.start(i);
  if (seconds >= SEEN * video.duration && (video.ended || seconds >= video.duration - 0.1)) {
    current.seen = true;
    refresh();
  }
}

function press(event) {
  if (!current || event.altKey || event.ctrlKey || event.metaKey || event.repeat) return;
  const at = event.target;
  if (event.key === " " && !at.closest("button, select, textarea, input, a")) {
    event.preventDefault();
    play(byId("video"));
    return;
  }
  if (event.key === "Enter" && !at.closest("button, select, textarea, a")) {
    event.preventDefault();
    next();
    return;
  }
  const answer = { ArrowLeft: "left", ArrowRight: "right", ArrowDown: "same" }[event.key];
  const question = current.asked[unanswered()];
  if (!answer || at.closest("select, textarea, input") || !current.seen || !question) return;
  if (question.answers.includes(answer)) {
    event.preventDefault();
    give(question.name, answer);
    if (unanswered() < 0) byId("next").focus();
  }
}

// Beginning.

function chooseLanguage() {
  const state = load();
  if (!study.languages.includes(state.language)) {
    const wanted = (navigator.languages || [navigator.language]).map((name) => name.toLowerCase().split("-")[0]);
    state.language = wanted.find((name) => study.languages.includes(name)) || study.languages[0];
  }
  const select = byId("language");
  select.replaceChildren(...study.languages.map((name) => new Option(study.texts[name].language, name)));
  select.value = state.language;
  select.hidden = study.languages.length < 2;
  select.onchange = () => { load().language = select.value; save(); translate(); };
}

function listen() {
  const video = byId("video");
  byId("agree").onchange = () => { byId("start").disabled = !byId("agree").checked; };
  byId("begin").onsubmit = (event) => { event.preventDefault(); if (byId("agree").checked) begin(); };
  byId("questions").onsubmit = (event) => { event.preventDefault(); next(); };
  byId("end").onsubmit = (event) => { event.preventDefault(); finish(); };
  byId("play").onclick = () => play(video);
  video.onclick = () => play(video);
  byId("play-reference").onclick = () => play(byId("reference"));
  byId("reference").onclick = () => play(byId("reference"));
  byId("restart").onclick = () => { if (confirm(text("restart_sure"))) { forget(); location.reload(); } };
  video.addEventListener("play", () => { if (current && video.currentTime < 0.2) current.plays += 1; label(); });
  for (const name of ["pause", "ended", "timeupdate"]) video.addEventListener(name, () => { watched(); label(); });
  video.addEventListener("error", () => { if (current) warn("broken", true); });
  video.addEventListener("loadeddata", () => warn("broken", false));
  document.addEventListener("keydown", press);
  window.addEventListener("online", send);
}

async function main() {
  hasServer = await findServer();
  chooseLanguage();
  byId("remark").textContent = study.remark;
  const state = load();
  if (state.number !== null) {
    byId("agree").checked = true;
    byId("start").disabled = false;
    byId("code").value = state.code;
    byId("code").disabled = true;
  }
  listen();
  show();
  send();
  window.facediffStudy = { get state() { return load(); }, get current() { return current; }, problems, hasServer, study };
}

main();
})();
