// What goes wrong is kept for scripts, and shown on the page.

const find = (id) => document.getElementById(id);
const errors = [];

/** Keep an error for scripts, and show it on the page. */
function report(error) {
  const words = error && error.message ? error.message : String(error);
  errors.push(words);
  find("message").textContent = words;
  find("message").hidden = false;
}

addEventListener("error", (event) => report(event.error ?? event.message));
addEventListener("unhandledrejection", (event) => report(event.reason));
addEventListener("securitypolicyviolation", (event) => report(`refused by the page's policy: ${event.blockedURI}`));
