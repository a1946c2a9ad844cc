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
new MutationObserver(() => {
  for (const frame of document.querySelectorAll("iframe[data-src]:not([data-seen])")) {
    frame.dataset.seen = "";
    frames.observe(frame);
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
function shown(part, first) {
  if (location.hash === `#${part}`) return;
  history[first ? "replaceState" : "pushState"](history.state, "", `#${part}`);
}
addEventListener("popstate", () => {
  if (location.hash) emitEvent("part", location.hash.slice(1));
});

// Undo and redo of the spec; in a field the keys are those of its own text.
addEventListener("keydown", (event) => {
  if (!(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z" || event.target.closest("input, textarea")) return;
  event.preventDefault();
  emitEvent(event.shiftKey ? "redo" : "undo");
});
