// Words about the animations and about the page. Names come from files: they are set as text, never as markup.

/** A new element with classes and text. */
function make(tag, classes, text) {
  const element = document.createElement(tag);
  if (classes) element.className = classes;
  if (text !== undefined) element.textContent = text;
  return element;
}

const plain = (word) => word.replaceAll("_", " ");

/** A list of terms and their descriptions. */
function describe(rows) {
  const list = make("dl");
  for (const [term, words] of rows) list.append(make("dt", "", plain(term)), make("dd", "", words));
  return list;
}

/** Fill the panel with what is known about each animation, and how exact the page is. */
function fillInformation(place, facts) {
  for (const animation of facts.animations) {
    const rows = [
      ["mesh", `${animation.vertices} vertices, ${animation.triangles} triangles`],
      ["length", `${facts.frames} frames, ${facts.frameRate} a second`],
      ...Object.entries(animation.metadata).filter(([name]) => (name !== "direction" || !animation.direction) && (name !== "phonemes" || !facts.sounds.length)),
    ];
    place.append(make("h3", "", animation.name), describe(rows));
  }
  const largest = ((Math.sqrt(3) / 2) * facts.step).toFixed(3);
  place.append(
    make("p", "fine", `Positions are rounded to ${facts.step} mm on each axis: no vertex is off by more than ${largest} mm.` +
      (facts.heat ? ` The heat map shows the distance of each vertex from the truth's, without any alignment.` : ""))
  );
}

/** The words below an animation's name, and marks for what is synthetic or procedural. */
function captions(animation) {
  const { identity, style, corpus, procedural } = animation.metadata;
  const words = [];
  if (identity) words.push(`identity ${identity}`);
  if (style) words.push(`style of ${style}`);
  const marks = [];
  if (/synthetic/i.test(corpus ?? "")) marks.push(`corpus: ${corpus}`);
  if (procedural) marks.push(`procedural: ${procedural}`);
  return { words, marks };
}

/** Buttons that open and close dialogs. */
function connectDialogs() {
  for (const button of document.querySelectorAll("[data-opens]")) {
    const dialog = document.getElementById(button.dataset.opens);
    button.addEventListener("click", () => dialog.showModal());
    dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  }
}
