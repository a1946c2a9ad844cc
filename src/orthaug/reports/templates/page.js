"use strict";
(async () => {
  const COLUMNS = 1400; // of pixels for which the least and the largest value of a curve are drawn
  const DENSE = 2; // samples in a column from which on a curve is drawn as an area
  const PAPER = 0.76; // height of a plot on paper over that on a screen
  const FONT = { family: "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif", size: 12 };
  const CONFIG = {
    responsive: false, displaylogo: false, doubleClick: "reset", showTips: false,
    modeBarButtons: [["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]],
  };
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const figures = JSON.parse(document.getElementById("figures").textContent);
  const places = [...document.querySelectorAll("[data-figure]")];
  const dark = matchMedia("(prefers-color-scheme: dark)");
  let onPaper = false;

  /* Plotly's script stands in the page compressed. */
  async function unpack() {
    const packed = bytes(document.getElementById("plotly").textContent);
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
  }

  function decode(series) {
    if (!series.y) {
      const raw = new Float32Array(bytes(series.f4).buffer);
      series.y = Float64Array.from(raw, (value) => value + series.shift);
    }
    return series;
  }

  /* The long curve of a trace: its own, or the difference of two. */
  function curve(figure, trace) {
    if (trace.minus) {
      const key = trace.minus.join(" less "), [a, b] = trace.minus.map((name) => decode(figure.series[name]));
      figure.series[key] ??= { x0: a.x0, dx: a.dx, y: a.y.map((value, i) => value - b.y[i]) };
      return figure.series[key];
    }
    return trace.series && decode(figure.series[trace.series]);
  }

  /* Points of a curve between two times: all, or the least and the largest in every column. */
  function outline({ x0, dx, y }, from, to, edge, plus) {
    const margin = to - from;
    const first = Math.max(0, Math.floor((from - margin - x0) / dx));
    const last = Math.min(y.length, Math.ceil((to + margin - x0) / dx) + 2);
    const stride = Math.max(1, Math.floor((to - from) / dx / COLUMNS));
    const xs = [], ys = [];
    const put = (i, value) => { xs.push(x0 + i * dx); ys.push(value); };
    for (let begin = first; begin < last; begin += stride) {
      let low = -1, high = -1;
      for (let i = begin; i < Math.min(begin + stride, last); i++) {
        if (!Number.isFinite(y[i])) continue;
        if (low < 0 || y[i] < y[low]) low = i;
        if (high < 0 || y[i] > y[high]) high = i;
      }
      if (edge) { if (low >= 0) put(begin, y[edge === "min" ? low : high] + plus); continue; }
      if (low < 0) { put(begin, null); continue; }
      put(Math.min(low, high), y[Math.min(low, high)]);
      if (low !== high) put(Math.max(low, high), y[Math.max(low, high)]);
    }
    return { x: xs, y: ys };
  }

  const style = () => getComputedStyle(document.documentElement);
  const color = (name, from) => from.getPropertyValue(`--${name}`).trim();

  /* Names such as @model become the colours of the theme. */
  function coloured(value, from) {
    if (value === "@diverging") {
      return [[0, color("physics", from)], [0.5, color("paper", from)], [1, color("residual", from)]];
    }
    if (typeof value === "string") return value.startsWith("@") ? color(value.slice(1), from) : value;
    if (Array.isArray(value)) return value.length && typeof value[0] === "number" ? value : value.map((v) => coloured(v, from));
    if (value && typeof value === "object" && !ArrayBuffer.isView(value)) {
      return Object.fromEntries(Object.entries(value).map(([key, v]) => [key, coloured(v, from)]));
    }
    return value;
  }

  /* Where many samples share a pixel a curve is the area between its least and largest values: the measured one
     filled, that of the model as its outline, so that both are seen. */
  function envelope(series, range, kind, line) {
    const low = outline(series, range[0], range[1], "min", 0), high = outline(series, range[0], range[1], "max", 0);
    const filled = kind === "area" ? { fill: "toself", fillcolor: line.color } : { fill: "none" };
    return {
      x: [...low.x, ...high.x.reverse(), low.x[0]], y: [...low.y, ...high.y.reverse(), low.y[0]], ...filled,
      line: { ...line, width: kind === "area" ? 0 : 1 },
    };
  }

  function traces(figure, range) {
    return figure.data.map((trace) => {
      const series = curve(figure, trace);
      const { series: _, minus, edge, plus, envelope: kind, ...own } = trace;
      if (!series) return own;
      const drawn = { type: "scatter", mode: "lines", fill: "none", ...own };
      const dense = kind && (range[1] - range[0]) / series.dx > DENSE * COLUMNS;
      return { ...drawn, ...(dense ? envelope(series, range, kind, own.line) : outline(series, range[0], range[1], edge, plus)) };
    });
  }

  const isNarrow = (width) => width < 520;
  const namesOf = (figure) => [...new Set(figure.data.flatMap((trace) => trace.y))];
  const lettered = (figure) => figure.data.some((trace) => trace.texttemplate);

  /* Letters after which a name goes on below: on a narrow screen, and on paper beside cells that hold numbers; else 0. */
  const folds = (figure, width) => (isNarrow(width) ? 12 : onPaper && lettered(figure) ? 24 : 0);
  const broken = (name, after) => (after ? name.replace(new RegExp(`(.{${after},}?)[ ,](?=.{4})`, "g"), "$1<br>") : name);

  /* Every name of a category axis. */
  function named(figure, width) {
    const names = namesOf(figure), after = folds(figure, width);
    return { tickvals: names, ticktext: names.map((name) => broken(name, after)), tickfont: { color: "@soft", size: after ? 9 : 12 } };
  }

  /* Pixels by which a figure is higher than planned, so that names on several lines leave each other room. */
  function taller(figure, width) {
    if (figure.layout.yaxis?.type !== "category" || !folds(figure, width)) return 0;
    const names = namesOf(figure), after = folds(figure, width);
    const most = Math.max(...names.map((name) => broken(name, after).split("<br>").length));
    return names.length * Math.max(0, 12 * most - (onPaper ? 16 : 22));
  }

  function layout(figure, from, width) {
    const narrow = isNarrow(width);
    const axis = {
      gridcolor: "@grid", linecolor: "@grid", zerolinecolor: "@grid", automargin: true, tickfont: { color: "@soft" },
      exponentformat: "power",
    };
    const own = structuredClone(figure.layout);
    for (const key of new Set([...Object.keys(own), "xaxis", "yaxis"])) {
      if (/^[xy]axis/.test(key)) {
        own[key] = { ...axis, ...own[key] };
        if (own[key].title) own[key].title = { standoff: 6, ...own[key].title };
        if (narrow) own[key].nticks = own[key].nticks ?? 5;
        if (key === "yaxis" && own[key].type === "category") Object.assign(own[key], named(figure, width));
      }
    }
    return coloured({
      margin: { l: narrow ? 48 : 64, r: narrow ? 8 : 16, t: 34, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { ...FONT, color: "@ink", size: narrow ? 11 : 12 }, dragmode: narrow ? false : "zoom", hovermode: "closest",
      hoverlabel: { bgcolor: "@shade", font: { color: "@ink" } },
      legend: { orientation: "h", x: 0, y: 1, yanchor: "bottom", xanchor: "left", bgcolor: "rgba(0,0,0,0)" },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: "@soft", activecolor: "@ink" },
      height: heightOf(figure, width), width, ...own,
    }, from);
  }

  /* On paper plots are lower, so that few pages end where the next plot does not fit. */
  const heightOf = (figure, width) => Math.round((onPaper ? PAPER : 1) * figure.height) + taller(figure, width);
  const widthOf = (place) => (onPaper ? (figures[place.dataset.figure].small ? 320 : 660) : Math.max(place.clientWidth || hidden(place), least(place)));
  /* Of a folded section: it is drawn anew when it is opened. */
  const hidden = (place) => (figures[place.dataset.figure].small ? 320 : document.querySelector("main").clientWidth);
  /* Cells that hold numbers keep their width; what does not fit a narrow screen is scrolled. */
  const least = (place) => Math.max(0, ...figures[place.dataset.figure].data.map((t) => (t.texttemplate ? 130 + 28 * t.x.length : 0)));
  const home = (figure) => figure.layout.xaxis?.range ?? [0, 1];
  const isSampled = (figure) => figure.data.some((trace) => trace.series || trace.minus);

  /* Red, green and blue of a colour #rgb or #rrggbb, from 0 to 1. */
  function parts(text) {
    const digits = text.length < 5 ? [...text.slice(1)].map((d) => d + d) : text.slice(1).match(/../g);
    return digits.map((pair) => parseInt(pair, 16) / 255);
  }
  const linear = (part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);
  const luminance = (rgb) => [0.2126, 0.7152, 0.0722].reduce((sum, weight, i) => sum + weight * linear(rgb[i]), 0);

  /* The numbers of a map's cells, black on light colours and white on dark ones. */
  function numbers(trace) {
    const scale = trace.colorscale.map(([at, text]) => [at, parts(text)]);
    const shade = (value) => {
      const share = Math.min(1, Math.max(0, (value - trace.zmin) / (trace.zmax - trace.zmin)));
      const k = Math.max(1, scale.findIndex(([at]) => share <= at)), [[from, low], [to, high]] = [scale[k - 1], scale[k]];
      return low.map((part, i) => part + ((share - from) / (to - from)) * (high[i] - part));
    };
    const ink = (value) => (luminance(shade(value ?? (trace.zmin + trace.zmax) / 2)) > 0.179 ? "#000000" : "#ffffff");
    return trace.z.flatMap((row, i) => row.map((value, j) => ({
      x: j, y: i, text: trace.text[i][j], showarrow: false, font: { size: trace.textfont.size, color: ink(value) },
    })));
  }

  function draw(place) {
    const figure = figures[place.dataset.figure], from = style();
    const now = place.layout && isSampled(figure) ? place.layout.xaxis.range : home(figure);
    const shown = layout(figure, from, widthOf(place));
    place.style.height = `${heightOf(figure, widthOf(place))}px`;
    if (isSampled(figure)) shown.xaxis.range = [...now];
    const drawn = traces(figure, now);
    if (isNarrow(shown.width) && lettered(figure)) drawn.forEach((trace) => { trace.textfont = { size: 8 }; });
    const painted = coloured(drawn, from);
    painted.filter((trace) => trace.texttemplate).forEach((trace) => {
      shown.annotations = numbers(trace);
      delete trace.texttemplate;
    });
    return Plotly.react(place, painted, shown, CONFIG);
  }

  /* After a zoom the curves are drawn anew, as finely as they are now seen. */
  function refine(place) {
    const figure = figures[place.dataset.figure];
    if (!isSampled(figure)) return;
    const range = place.layout.xaxis.range.map(Number);
    const fresh = traces(figure, range), which = figure.data.map((t, i) => (t.series || t.minus ? i : -1)).filter((i) => i >= 0);
    const drawn = coloured(fresh, style()), each = (of) => which.map((i) => of(drawn[i]));
    Plotly.restyle(place, {
      x: each((t) => t.x), y: each((t) => t.y), fill: each((t) => t.fill ?? "none"),
      fillcolor: each((t) => t.fillcolor ?? null), "line.width": each((t) => t.line?.width ?? 1.3),
    }, which);
    const button = place.parentElement.querySelector(".whole-record");
    if (button) button.setAttribute("aria-pressed", String(range[0] <= figure.whole[0] && range[1] >= figure.whole[1]));
  }

  function keys(place, event) {
    const figure = figures[place.dataset.figure];
    if (event.target !== place || !isSampled(figure) || event.ctrlKey || event.metaKey || event.altKey) return;
    const [low, high] = place.layout.xaxis.range.map(Number), width = high - low;
    const moves = {
      ArrowLeft: [low - width / 4, high - width / 4], ArrowRight: [low + width / 4, high + width / 4],
      "+": [low + width / 4, high - width / 4], "-": [low - width / 2, high + width / 2], 0: figure.whole ?? home(figure),
    };
    const range = moves[event.key === "=" ? "+" : event.key];
    if (!range) return;
    event.preventDefault();
    Plotly.relayout(place, { "xaxis.range": [...range] });
  }

  /* In a frame the page has no scrollbar of its own: it says how high it is, and which place a link leads to. */
  function fillFrame() {
    const send = (place) => parent.postMessage(place, "*");
    new ResizeObserver(() => send({ reportHeight: document.documentElement.offsetHeight })).observe(document.documentElement);
    document.querySelectorAll("a[href^='#']").forEach((link) => link.addEventListener("click", () => setTimeout(() => {
      const target = document.getElementById(link.hash.slice(1));
      if (target) send({ reportPlace: target.getBoundingClientRect().top + scrollY });
    })));
  }

  const redraw = () => places.forEach(draw);
  if (parent !== window) fillFrame();
  try {
    await unpack();
    for (const place of places) {
      await draw(place);
      place.on("plotly_relayout", (changed) => {
        if (Object.keys(changed).some((key) => key.startsWith("xaxis"))) refine(place);
      });
      place.addEventListener("keydown", (event) => keys(place, event));
      const button = place.parentElement.querySelector(".whole-record");
      button?.addEventListener("click", () => {
        const figure = figures[place.dataset.figure], whole = button.getAttribute("aria-pressed") === "false";
        Plotly.relayout(place, { "xaxis.range": [...(whole ? figure.whole : home(figure))] });
      });
    }
    document.querySelectorAll(".folded").forEach((section) => section.addEventListener("toggle", () => {
      if (section.open && !onPaper) section.querySelectorAll("[data-figure]").forEach(draw);
    }));
    const unfold = () => {
      const target = location.hash.length > 1 && document.getElementById(location.hash.slice(1));
      const folded = target && target.querySelector(":scope > .folded");
      if (folded) { folded.open = true; target.scrollIntoView(); }
    };
    addEventListener("hashchange", unfold);
    document.querySelectorAll("nav a").forEach((link) => link.addEventListener("click", () => setTimeout(unfold)));
    unfold();
    dark.addEventListener("change", redraw);
    let waiting, width = innerWidth;
    addEventListener("resize", () => {
      if (innerWidth === width || onPaper) return;
      width = innerWidth;
      clearTimeout(waiting);
      waiting = setTimeout(redraw, 120);
    });
    const paper = (now) => { onPaper = now; document.documentElement.toggleAttribute("data-paper", now); redraw(); };
    addEventListener("beforeprint", () => {
      document.querySelectorAll("details").forEach((folded) => { folded.open = true; });
      paper(true);
    });
    addEventListener("afterprint", () => paper(false));
    document.documentElement.dataset.drawn = String(places.length);
  } catch (error) {
    document.getElementById("undrawn").hidden = false;
    document.documentElement.dataset.drawn = "none";
    throw error;
  }
})();
