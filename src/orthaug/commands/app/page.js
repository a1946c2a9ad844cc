// A file that is dropped goes to the server piece by piece; how far it is, is shown.
document.addEventListener("change", (event) => {
  if (event.target.id === "dropped" && event.target.files.length) take(event.target.files[0]);
});
for (const name of ["dragover", "dragenter", "dragleave", "drop"]) {
  document.addEventListener(name, (event) => {
    if (!event.dataTransfer || ![...event.dataTransfer.types].includes("Files")) return;
    event.preventDefault();
    const zone = document.getElementById("drop");
    if (!zone) return;
    zone.classList.toggle("over", name === "dragover" || name === "dragenter");
    if (name === "drop" && event.dataTransfer.files.length) take(event.dataTransfer.files[0]);
  });
}

function take(file) {
  const message = document.getElementById("drop-message"), bar = document.getElementById("drop-bar");
  const request = new XMLHttpRequest();
  request.open("PUT", `${location.pathname}/file/${encodeURIComponent(file.name)}`);
  request.upload.onprogress = (event) => {
    bar.hidden = false;
    bar.value = event.total ? event.loaded / event.total : 0;
    message.textContent = `${file.name}: ${Math.round(100 * bar.value)} %`;
  };
  request.onload = () => {
    bar.hidden = true;
    let answer = {};
    try { answer = JSON.parse(request.responseText); } catch { /* the message is below */ }
    message.textContent = answer.refused ?? (answer.kept ? answer.note || `${answer.kept} is here` : "the file could not be taken in");
    message.classList.toggle("refused", !answer.kept);
    document.getElementById("dropped").value = "";
  };
  request.onerror = () => {
    bar.hidden = true;
    message.textContent = "the server does not answer; is orthaug app still running?";
    message.classList.add("refused");
  };
  request.send(file);
}

// Plots take the width that there is, once they have one.
const widths = new ResizeObserver((entries) => entries.forEach((entry) => fit(entry.target)));
// A report is laid out once, so it is loaded when its frame has the width that it keeps.
const frames = new ResizeObserver((entries) => entries.forEach(({ target }) => {
  if (target.offsetWidth < 0.8 * target.parentElement.parentElement.offsetWidth || !target.offsetWidth) return;
  frames.unobserve(target);
  requestAnimationFrame(() => requestAnimationFrame(() => (target.src = target.dataset.src)));
}));
// A report is as high as it says, so that it scrolls with the page; a link in it scrolls the page.
addEventListener("message", ({ data, source }) => {
  const frame = [...document.querySelectorAll("iframe.report")].find((one) => one.contentWindow === source);
  if (!frame) return;
  if (data?.reportHeight > 0) frame.style.height = `${Math.ceil(Number(data.reportHeight)) + 2}px`;
  if (data?.reportPlace >= 0) scrollTo({ top: frame.getBoundingClientRect().top + scrollY + Number(data.reportPlace) - 80 });
});
new MutationObserver(() => {
  for (const frame of document.querySelectorAll("iframe[data-src]:not([data-seen])")) {
    frame.dataset.seen = "";
    frames.observe(frame);
  }
  for (const panel of document.querySelectorAll(".sticky:not([data-seen])")) {
    panel.dataset.seen = "";
    panels.observe(panel);
  }
  for (const plot of document.querySelectorAll(".plot:not([data-fit])")) {
    plot.dataset.fit = "";
    widths.observe(plot);
  }
}).observe(document, { childList: true, subtree: true });

async function fit(plot) {
  const { Plotly } = await import("nicegui-plotly");
  for (let i = 0; i < 20 && plot.isConnected && !plot._fullLayout; i++) await new Promise((go) => setTimeout(go, 50));
  const width = plot.isConnected && plot._fullLayout ? plot.offsetWidth : 0;
  if (width && Math.abs(plot._fullLayout.width - width) > 1) Plotly.relayout(plot, { autosize: true, width });
}

// Where the control that had the focus is drawn anew, gone or disabled, its successor or else its card has it next.
let held = null;
const called = (control) =>
  `${control.closest("[role=group]")?.ariaLabel} ${control.dataset.place ?? control.ariaLabel ?? control.innerText}`;
const alive = (control) => control.isConnected && !control.disabled && control.getClientRects().length;
const CONTROLS = "a, button, input, select, textarea";
addEventListener("focusin", (event) => {
  const target = event.target.closest(CONTROLS);
  held = target && { target, name: called(target), card: target.closest(".card") };
});
setInterval(() => {
  if (!held || document.activeElement !== document.body || alive(held.target)) return;
  const { name, card } = held;
  const all = [...document.querySelectorAll(CONTROLS)];
  const next = all.find((control) => called(control) === name && alive(control));
  if (next) return next.focus();
  const place = card?.isConnected ? card : document.querySelector("[role=tab][aria-selected=true]");
  if (place.tabIndex < 0) place.tabIndex = -1;
  place.focus({ preventScroll: true });
}, 100);

// The part that is shown stands behind # in the address, so that Back and Forward go through the parts.
// Each part is found again as it was left, after a reload too: where it was scrolled to, and what was typed.
history.scrollRestoration = "manual";
const memory = (what) => `${what} ${location.pathname} ${location.hash}`;
let arriving = 0; // until when the place of a part is sought, while it is still being drawn
function shown(part, first) {
  if (location.hash !== `#${part}`) history[first ? "replaceState" : "pushState"](history.state, "", `#${part}`);
  arrive();
}
function arrive() {
  const place = +sessionStorage.getItem(memory("scroll"));
  arriving = Date.now() + 30_000; // a slow machine draws a part many seconds late; a key or the mouse ends it
  let there = 0; // since when; what is drawn late may still move it for a moment
  const seek = () => {
    scrollTo(0, place);
    if (Math.abs(scrollY - place) < 2) arriving = place ? Math.min(arriving, (there ||= Date.now()) + 500) : 0;
    if (Date.now() < arriving) requestAnimationFrame(seek);
  };
  requestAnimationFrame(seek);
}
for (const name of ["wheel", "pointerdown", "keydown", "touchstart"]) addEventListener(name, () => (arriving = 0), { passive: true });
function keepScroll(key) {
  if (Date.now() >= arriving && key === memory("scroll")) sessionStorage.setItem(key, Math.round(scrollY));
}
let scrolled = 0; // a part that is being left must not keep where the next one stands
addEventListener("scroll", () => {
  clearTimeout(scrolled);
  scrolled = setTimeout(keepScroll, 400, memory("scroll"));
});
addEventListener("pagehide", () => keepScroll(memory("scroll")));
addEventListener("load", arrive);
addEventListener("popstate", () => {
  if (!location.hash) return;
  emitEvent("part", location.hash.slice(1));
  arrive();
});

// What is in a field and was not taken yet, under the name of the field.
const TYPED = "input:not([type=file]), textarea";
const drafts = () => JSON.parse(sessionStorage.getItem(memory("typed")) ?? "{}");
function keepDraft(control, value) {
  const all = drafts();
  if (value === null) delete all[called(control)];
  else all[called(control)] = value;
  sessionStorage.setItem(memory("typed"), JSON.stringify(all));
}
const taken = new WeakMap();
addEventListener("input", ({ target }) => {
  if (!target.matches?.(TYPED)) return;
  keepDraft(target, target.value);
  clearTimeout(taken.get(target)); // the text of the spec is taken while it is written
  if (target.closest(".editor")) taken.set(target, setTimeout(keepDraft, 1500, target, null));
});
addEventListener("change", ({ target }) => target.matches?.(TYPED) && keepDraft(target, null));
const returning = setInterval(() => {
  for (const control of document.querySelectorAll(TYPED)) {
    const text = control.dataset.back === undefined ? drafts()[called(control)] : undefined;
    if (text === undefined) continue;
    control.dataset.back = "";
    if (text === control.value) continue;
    control.value = text;
    control.dispatchEvent(new InputEvent("input", { bubbles: true }));
  }
}, 200);
addEventListener("load", () => setTimeout(() => clearInterval(returning), 5000));

// A panel beside the page stays in sight; one that is taller than the window goes up until its end is seen.
const panels = new ResizeObserver((entries) => entries.forEach(({ target }) => settle(target)));
function settle(panel) {
  panel.style.top = `${Math.min(64, innerHeight - panel.offsetHeight - 16)}px`;
}
addEventListener("resize", () => document.querySelectorAll(".sticky").forEach(settle));

// Undo and redo of the spec; in a field the keys are those of its own text.
addEventListener("keydown", (event) => {
  if (!(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z" || event.target.closest("input, textarea")) return;
  event.preventDefault();
  emitEvent(event.shiftKey ? "redo" : "undo");
});
