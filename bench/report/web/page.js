/* Filters, charts, the table and the selected cell of a page, drawn from the columns in #data.

   A table is columns by name: a list of numbers (null where there is none), or texts as {values, index}. The table
   "rows" has a line per cell; in the others the column "row" has the index in "rows" that a line comes from, or -1.
   Texts reach the page only through textContent or plotted(), so that none is taken for HTML. */
"use strict";

const page = JSON.parse(document.getElementById("data").textContent);
const rowCount = size("rows");
const SMALL = 12; // size of the smallest text in a chart [px]
const PANELS = 4; // most panels of a chart that are drawn at once
const CROWD = 1000; // most points that a panel draws, of more only one is drawn of those close together
const FIRST = 60, MORE = 240; // rows of the table at first, and with every "Show more"
const GLYPHS = {
  circle: "●", square: "■", diamond: "◆", "triangle-up": "▲", "triangle-down": "▼", cross: "✚", x: "✖", star: "★", line: "━",
};
const GONE = "The experiment, as configured when this page was written, has no such cell any more.";
const state = { chosen: {}, find: "", sort: null, limit: FIRST, selected: -1, theme: "auto" };
let visible = new Uint8Array(rowCount).fill(1);
let searchable = null;

// ------------------------------------------------------------------------------------------------------ columns

function size(table) {
  const column = Object.values(page.tables[table])[0];
  return (column.index || column).length;
}

/* A function from a line of a table to its value in a column, looked up in "rows" where the table has no such column. */
function reader(table, name) {
  const key = table + " " + name;
  if (!readers.has(key)) readers.set(key, readerOf(table, name));
  return readers.get(key);
}

const readers = new Map();

function readerOf(table, name) {
  const column = page.tables[table][name];
  if (column) return column.index ? (i) => column.values[column.index[i]] : (i) => column[i];
  if (table === "rows") return () => null;
  const row = page.tables[table].row;
  const read = reader("rows", name);
  return (i) => read(row[i]);
}

/* Lines of no cell are not filtered. */
const isShown = (row) => row < 0 || visible[row];
const isText = (table, name) => Boolean((page.tables[table][name] || page.tables.rows[name] || {}).index);

const rowOf = (table) => (table === "rows" ? (i) => i : (i) => page.tables[table].row[i]);

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children.filter((child) => child !== null));
  return made;
}

// ------------------------------------------------------------------------------------------------------ numbers

function number(value) {
  if (value === null || value === undefined) return "-";
  if (typeof value === "string") return value;
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e-3 && size < 1e5) return String(Number(value.toPrecision(3)));
  return value.toExponential(2).replace(/\.?0+e/, "e").replace("e+", "e");
}

function exact(value) {
  if (value === null || value === undefined) return "-";
  if (typeof value !== "number" || value === 0) return String(value);
  const size = Math.abs(value);
  return size >= 1e-3 && size < 1e5 ? String(value) : value.toExponential().replace("e+", "e");
}

function duration(seconds) {
  if (seconds === null) return "-";
  if (seconds < 0.9995e-3) return number(seconds * 1e6) + " µs";
  return seconds < 0.9995 ? number(seconds * 1e3) + " ms" : number(seconds) + " s";
}

function shownAs(column, row) {
  const value = reader("rows", column.name)(row);
  if (column.kind === "text") return value === null ? "" : String(value);
  const flagged = column.flag && value !== null && reader("rows", column.flag)(row);
  if (column.kind === "seconds") return duration(value) + (flagged ? " !" : "");
  if (column.kind === "limit" && flagged) return "< " + number(value);
  return page.identity.includes(column.name) ? exact(value) : number(value);
}

/* A text as Plotly shows it literally: it takes a few tags for markup. */
const plotted = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");

const coordinate = (value) => (typeof value === "string" ? plotted(value) : value);

// ------------------------------------------------------------------------------------------------------ filters

function buildFilters() {
  const place = document.getElementById("filters");
  for (const name of page.filters) {
    const read = reader("rows", name);
    const counts = new Map();
    for (let i = 0; i < rowCount; i++) counts.set(read(i), (counts.get(read(i)) || 0) + 1);
    const values = [...counts.keys()];
    if (typeof values.find((value) => value !== null) === "number") values.sort((a, b) => a - b);
    const summary = element("summary", { textContent: name.replace(/_/g, " ") });
    const box = element("details", {}, summary);
    const inputs = values.map((value) => element("input", { type: "checkbox", checked: true }));
    const update = () => {
      const kept = values.filter((_, k) => inputs[k].checked);
      const all = kept.length === values.length;
      if (all) delete state.chosen[name];
      else state.chosen[name] = new Set(kept);
      box.classList.toggle("active", !all);
      summary.textContent = name.replace(/_/g, " ") + (all ? "" : ` ${kept.length}/${values.length}`);
      refresh();
    };
    const all = element("button", { type: "button", textContent: "all" });
    const none = element("button", { type: "button", textContent: "none" });
    const set = (checked) => () => { inputs.forEach((input) => (input.checked = checked)); update(); };
    all.addEventListener("click", set(true));
    none.addEventListener("click", set(false));
    const labels = values.map((value, k) => {
      inputs[k].addEventListener("change", update);
      inputs[k].dataset.value = String(value);
      const text = element("span", { textContent: value === "" ? "(default)" : exact(value) });
      return element("label", {}, inputs[k], text, element("small", { textContent: counts.get(value) }));
    });
    box.dataset.column = name;
    box.reset = () => inputs.forEach((input) => (input.checked = true));
    box.keep = (kept) => inputs.forEach((input) => (input.checked = !kept || kept.includes(input.dataset.value)));
    box.update = update;
    box.append(element("fieldset", { ariaLabel: name }, all, none, ...labels));
    place.append(box);
  }
  document.addEventListener("click", (event) => {
    for (const box of place.children) if (!box.contains(event.target)) box.open = false;
  });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    for (const box of place.children) {
      if (box.open) { box.open = false; box.querySelector("summary").focus(); }
    }
  });
  document.getElementById("clear").addEventListener("click", () => {
    state.chosen = {};
    state.find = document.getElementById("find").value = "";
    for (const box of place.children) box.reset();
    for (const box of place.children) box.update();
  });
  document.getElementById("find").addEventListener("input", (event) => {
    state.find = event.target.value.trim().toLowerCase();
    refresh();
  });
  document.getElementById("csv").addEventListener("click", saveCsv);
  addEventListener("hashchange", () => { if (location.hash !== written) fromAddress(); });
}

/* The address keeps the filters, #estimator=fobg,reinforce&find=jax, so that a link shows what its sender saw. */
let written = "";

function toAddress() {
  const parts = Object.entries(state.chosen).map(([name, kept]) =>
    encodeURIComponent(name) + "=" + [...kept].map((value) => encodeURIComponent(String(value))).join(","));
  if (state.find) parts.push("find=" + encodeURIComponent(state.find));
  written = parts.length ? "#" + parts.join("&") : "";
  if (location.hash !== written) history.replaceState(null, "", written || location.pathname + location.search);
}

function fromAddress() {
  const given = new Map();
  for (const part of location.hash.slice(1).split("&").filter(Boolean)) {
    const [name, ...rest] = part.split("=");
    try {
      given.set(decodeURIComponent(name), rest.join("=").split(",").map(decodeURIComponent));
    } catch { /* not an address that this page wrote */ }
  }
  const find = given.get("find");
  state.find = document.getElementById("find").value = find ? find.join(",") : "";
  const boxes = [...document.getElementById("filters").children];
  for (const box of boxes) box.keep(given.get(box.dataset.column));
  for (const box of boxes) box.update();
}

/* The cells shown, in the order of the table, every digit that the page has. */
function csv() {
  const names = [...new Set([...page.identity, ...page.columns.map((column) => column.name)])].filter((name) => page.tables.rows[name]);
  const quoted = (value) => {
    const text = value === null || value === undefined ? "" : String(value);
    return /[",\r\n]/.test(text) ? '"' + text.replace(/"/g, '""') + '"' : text;
  };
  const readers = names.map((name) => reader("rows", name));
  const lines = order().map((i) => readers.map((read) => quoted(read(i))).join(","));
  return [names.map(quoted).join(","), ...lines].join("\n") + "\n";
}

function saveCsv() {
  const address = URL.createObjectURL(new Blob([csv()], { type: "text/csv" }));
  element("a", { href: address, download: document.title.replace(/\W+/g, "_") + ".csv" }).click();
  setTimeout(() => URL.revokeObjectURL(address), 1000);
}

function applyFilters() {
  const tests = Object.entries(state.chosen).map(([name, kept]) => [reader("rows", name), kept]);
  if (state.find && !searchable) {
    searchable = Array.from({ length: rowCount }, (_, i) =>
      page.columns.map((column) => shownAs(column, i)).join(" ").toLowerCase());
  }
  let count = 0;
  for (let i = 0; i < rowCount; i++) {
    visible[i] = tests.every(([read, kept]) => kept.has(read(i))) && (!state.find || searchable[i].includes(state.find));
    count += visible[i];
  }
  document.getElementById("shown").textContent = `${count} of ${rowCount} cells shown`;
}

function refresh() {
  const started = performance.now();
  applyFilters();
  toAddress();
  state.limit = FIRST;
  drawTable();
  markDirty();
  document.documentElement.dataset.filtered = (performance.now() - started).toFixed(1);
}

// ------------------------------------------------------------------------------------------------------- charts

const charts = page.charts.map((chart) => ({ ...chart, xAxis: chart.x[0], yAxis: chart.y[0], only: "", dirty: true }));
let observer = null;

function buildCharts() {
  const place = document.getElementById("charts");
  observer = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const chart = charts.find((one) => one.section === entry.target);
      chart.near = entry.isIntersecting;
    }
    requestAnimationFrame(drawNext);
  }, { rootMargin: "300px" });
  for (const chart of charts) {
    chart.section = element("section", { className: "chart" },
      element("h2", { textContent: chart.title }), element("p", { textContent: chart.text }));
    chart.options = element("div", { className: "options" });
    chart.legend = element("ul", { className: "legend" });
    chart.panels = element("div", { className: "panels" });
    if (chart.x.length > 1) chart.options.append(choice(chart, "x axis", "xAxis", chart.x));
    if (chart.y.length > 1) chart.options.append(choice(chart, "y axis", "yAxis", chart.y));
    chart.note = element("span", { className: "hint" });
    chart.picker = element("select");
    chart.picker.addEventListener("change", () => { chart.only = chart.picker.value; drawChart(chart); });
    chart.pick = element("label", { hidden: true }, "panel ", chart.picker);
    chart.options.append(chart.pick, chart.note);
    chart.section.append(chart.options, chart.legend, chart.panels);
    place.append(chart.section);
    observer.observe(chart.section);
  }
}

function choice(chart, label, property, axes) {
  const select = element("select", {}, ...axes.map((axis, k) => element("option", { value: k, textContent: axis.label })));
  select.addEventListener("change", () => { chart[property] = axes[Number(select.value)]; drawChart(chart); });
  return element("label", {}, label + " ", select);
}

/* Charts in sight are drawn one per frame, so that the page stays responsive; the others when they come into sight. */
function markDirty() {
  for (const chart of charts) chart.dirty = true;
  requestAnimationFrame(drawNext);
}

function drawNext() {
  const chart = charts.find((one) => one.near && one.dirty);
  if (!chart || !window.Plotly) return;
  drawChart(chart);
  requestAnimationFrame(drawNext);
}

function dark() {
  if (state.theme !== "auto") return state.theme === "dark";
  return matchMedia("(prefers-color-scheme: dark)").matches;
}

const LOST = { colour: ["#757575", "#9a9a9a"], symbol: "circle", dash: "solid" };
const looks = (chart, name) => chart.looks[name] || LOST;
const filling = (chart, name) => looks(chart, name).colour[dark() ? 1 : 0];
const GROUND = ["#ffffff", "#14171a"], INK = ["#16191d", "#e9ecef"];
const MARK = 3, TEXT = 4.5; // contrasts that WCAG level AA asks for
const ground = () => GROUND[dark() ? 1 : 0];
const ink = () => INK[dark() ? 1 : 0];
const colour = (chart, name) => readable(filling(chart, name), MARK);

const channels = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));

function mixed(from, to, share) {
  const end = channels(to);
  return "#" + channels(from).map((part, k) => Math.round(part + share * (end[k] - part)).toString(16).padStart(2, "0")).join("");
}

/* The contrast of two colours, from 1 to 21, by WCAG 2. */
function contrast(one, other) {
  const [a, b] = [one, other].map((hex) => channels(hex).map((part) => part / 255)
    .map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4))
    .reduce((sum, part, k) => sum + [0.2126, 0.7152, 0.0722][k] * part, 0.05));
  return Math.max(a / b, b / a);
}

/* The colour, mixed with the colour of text as far as needed for a contrast with the page. */
function readable(hex, least) {
  for (let share = 0; share < 1; share += 0.05) {
    const found = mixed(hex, ink(), share);
    if (contrast(found, ground()) >= least) return found;
  }
  return ink();
}

const NARROWEST = 52; // width of a map's column in pixels below which its cells have letters instead of their texts
const hasNames = (chart) => isText(chart.table, chart.yAxis.column); // then x has the values, and y a row per name
const isMap = (chart) => Boolean(chart.level || chart.fill);

/* The height of the names on the vertical axis, in lines of text. */
function lineCount(chart, panel) {
  if (isMap(chart)) return panel.y.size;
  return hasNames(chart) ? panel.rows.size * Math.max(1, 0.5 * (panel.names.size - 1) * panel.isSpread) : 0;
}

function drawChart(chart) {
  if (!window.Plotly) return;
  chart.dirty = false;
  const facets = isMap(chart) ? mapPanels(chart) : pointPanels(chart);
  const names = [...facets.keys()];
  chart.pick.hidden = names.length <= PANELS;
  if (!chart.pick.hidden) {
    const label = `the first ${PANELS} of ${names.length}`;
    chart.picker.replaceChildren(element("option", { value: "", textContent: label }),
      ...names.map((name) => element("option", { value: name, textContent: name })));
    if (!facets.has(chart.only)) chart.only = "";
    chart.picker.value = chart.only;
  } else chart.only = "";
  const drawn = chart.only ? [chart.only] : names.slice(0, PANELS);
  chart.note.textContent = names.length ? "" : "nothing to draw among the cells shown";
  chart.panels.dataset.count = drawn.length;
  const range = isMap(chart) ? null : ranges(chart, drawn.map((name) => facets.get(name)));
  const own = hasNames(chart) ? "x" : "y"; // the axis whose scale a panel may have for itself
  const rangeOf = (panel) => (chart.own_scales ? { ...range, [own]: ranges(chart, [panel])[own] } : range);
  while (chart.panels.children.length > drawn.length) {
    Plotly.purge(chart.panels.lastChild.lastChild);
    chart.panels.lastChild.remove();
  }
  drawn.forEach((name, k) => {
    if (!chart.panels.children[k]) {
      const plot = element("div", { className: "plot" });
      chart.panels.append(element("div", {}, element("h3"), element("p", { className: "hint" }), plot));
    }
    const [title, note, plot] = chart.panels.children[k].children;
    title.textContent = name;
    title.hidden = !name;
    note.textContent = chart.notes[name] || "";
    note.hidden = !chart.notes[name];
    const lines = lineCount(chart, facets.get(name));
    plot.style.height = lines > 12 ? `${60 + 24 * lines}px` : "";
    plot.style.minHeight = isMap(chart) && lines <= 12 ? `${150 + 24 * lines}px` : ""; // with slanted names below, on a phone
    const [traces, layout] = isMap(chart) ? mapFigure(chart, facets.get(name)) : pointFigure(chart, name, facets.get(name), rangeOf(facets.get(name)));
    Plotly.react(plot, traces, layout, { displayModeBar: false, responsive: true });
    plot.removeAllListeners("plotly_click");
    plot.on("plotly_click", (event) => {
      const row = event.points[0].customdata;
      if (Number.isInteger(row)) select(row);
    });
  });
  drawLegend(chart, drawn.map((name) => facets.get(name)));
}

function drawLegend(chart, panels) {
  const names = new Set();
  for (const panel of panels) for (const name of panel.names) names.add(name);
  const ordered = Object.keys(chart.looks).filter((name) => names.has(name));
  chart.legend.replaceChildren(...ordered.map((name) => {
    const look = looks(chart, name);
    const mark = element("b", { textContent: chart.level ? look.letter || "\u2003" : GLYPHS[look.symbol] });
    if (chart.level) { mark.className = "level"; mark.style.background = filling(chart, name); mark.style.color = inkOn(filling(chart, name)); }
    else mark.style.color = colour(chart, name);
    return element("li", {}, mark, " " + (look.meaning || name));
  }));
}

const inkOn = (hex) => (contrast(hex, "#000000") > contrast(hex, "#ffffff") ? "#000000" : "#ffffff");

/* The points to draw: panels by name, each with the points of a line or series, and all its points by front. */
function pointPanels(chart) {
  const [x, y] = [chart.xAxis, chart.yAxis];
  const read = (name) => (name ? reader(chart.table, name) : () => null);
  const [X, Y, low, high, limit, left, right, leftLimit] =
    [x.column, y.column, y.low, y.high, y.limit, x.low, x.high, x.limit].map(read);
  const [series, facet, line, front, failed] = [chart.series, chart.facet, chart.line, chart.front, chart.failed].map(read);
  const isKnown = (axis, value) => value !== null && !(axis.log && value <= 0);
  const row = rowOf(chart.table);
  const panels = new Map();
  for (let i = 0, count = size(chart.table); i < count; i++) {
    const point = { row: row(i), x: X(i), y: Y(i) };
    const [hasX, hasY] = [isKnown(x, point.x), isKnown(y, point.y)];
    const isLost = Boolean(failed(i)) && (hasNames(chart) ? hasY && !hasX : hasX && !hasY);
    if (!isShown(point.row) || !((hasX && hasY) || isLost)) continue;
    Object.assign(point, { low: low(i), high: high(i), limit: limit(i), series: series(i) || "" });
    Object.assign(point, { left: left(i), right: right(i), leftLimit: leftLimit(i) });
    const name = facet(i) || "";
    if (!panels.has(name)) panels.set(name, { lines: new Map(), fronts: new Map(), names: new Set(), lost: [] });
    const panel = panels.get(name);
    panel.names.add(point.series);
    if (isLost) {
      panel.lost.push(point);
      continue;
    }
    append(panel.lines, chart.line ? line(i) : point.series, point);
    if (chart.front) append(panel.fronts, front(i), point);
  }
  if (hasNames(chart)) for (const panel of panels.values()) placeRows(chart, panel);
  return panels;
}

/* Rows of names in the order of the table, the first at the top, with the series of a row below each other. */
function placeRows(chart, panel) {
  const values = page.tables[chart.table][chart.yAxis.column] || page.tables.rows[chart.yAxis.column];
  const points = [...[...panel.lines.values()].flat(), ...panel.lost];
  const here = new Set(points.map((point) => point.y));
  const series = Object.keys(chart.looks).filter((name) => panel.names.has(name));
  panel.rows = new Map(values.values.filter((name) => here.has(name)).map((name, k) => [name, k]));
  panel.isSpread = series.length > 1 && !chart.join && here.size < points.length;
  for (const point of points) {
    const place = panel.isSpread ? (0.7 * (series.indexOf(point.series) - (series.length - 1) / 2)) / series.length : 0;
    point.height = panel.rows.get(point.y) + place;
  }
}

const heightOf = (point) => (point.height === undefined ? coordinate(point.y) : point.height);

function append(map, key, value) {
  if (map.has(key)) map.get(key).push(value);
  else map.set(key, [value]);
}

/* One range of each axis for some panels together. */
function ranges(chart, panels) {
  const find = (axis, values) => {
    if (!values.length || values.some((value) => typeof value === "string")) return undefined;
    const scaled = axis.log ? values.map(Math.log10) : values;
    const [first, last] = [scaled.reduce((a, b) => Math.min(a, b)), scaled.reduce((a, b) => Math.max(a, b))];
    const margin = Math.max(0.08 * (last - first), axis.log ? 0.08 : 1e-9);
    return [first - margin, last + margin * (axis === lossy ? 2 : 1)]; // room for crosses
  };
  const lossy = panels.some((panel) => panel.lost.length) ? (hasNames(chart) ? chart.xAxis : chart.yAxis) : null;
  const points = panels.flatMap((panel) => [...panel.lines.values()].flat());
  const ends = (marks) => (points.length ? Object.values(marks).flat().filter((end) => end !== null) : []);
  return { x: find(chart.xAxis, [...points.map((p) => p.x), ...ends(chart.marks)]),
    y: find(chart.yAxis, [...points.map((p) => p.y), ...ends(chart.y_marks)]) };
}

function pointFigure(chart, name, panel, range) {
  const traces = [];
  const joined = Boolean(chart.line);
  const every = [...panel.lines.values()];
  if (panel.lost.length) traces.push(...crosses(chart, panel.lost, range));
  const kept = apart(chart, every.flat(), range);
  if (kept) chart.note.textContent = `${kept.size} of ${every.flat().length} points are drawn: of those close together one`;
  for (const points of every) {
    const drawn = kept ? points.filter((point) => kept.has(point)) : points;
    if (drawn.length) traces.push(trace(chart, drawn, joined));
  }
  if (chart.front) traces.push(...frontTraces(panel, kept));
  if (chart.join) traces.unshift(...joins(panel));
  const chosen = [...panel.lines.values()].flat().filter((point) => point.row >= 0 && point.row === state.selected);
  if (chosen.length) traces.push(rings(chosen, 17, 3, colour(chart, "")));
  const shapes = [], annotations = [];
  if (range.y && chart.yAxis.log && chart.yAxis.above_one && range.y[1] > 0) {
    shapes.push({ type: "rect", xref: "paper", x0: 0, x1: 1, y0: 1, y1: 10 ** range.y[1], layer: "below",
      fillcolor: dark() ? "#ffffff14" : "#00000010", line: { width: 0 } });
    annotations.push({ xref: "paper", x: 0.01, y: Math.max(0, range.y[0]), yanchor: "bottom", xanchor: "left", showarrow: false,
      text: chart.yAxis.above_one, font: { size: SMALL } });
  }
  for (const [axis, marks] of [["x", chart.marks], ["y", chart.y_marks]]) {
    for (const [label, value] of Object.entries(marks)) mark(chart, axis, label, value, range, shapes, annotations);
  }
  annotations.push(...backendNames(chart, panel, joined, range));
  return [traces, { ...frame(chart, panel, range), shapes, annotations }];
}

/* The points to draw of a crowd, one for each cell of a grid that is as fine as CROWD allows; null to draw all. */
function apart(chart, points, range) {
  if (points.length <= CROWD || !range.x || !range.y) return null;
  const place = (value, axis, [low, high], count) => Math.round(count * ((axis.log ? Math.log10(value) : value) - low) / (high - low));
  for (let count = 400; ; count /= 2) {
    const cells = new Map();
    for (const p of points) {
      const cell = `${p.series} ${place(p.x, chart.xAxis, range.x, count)} ${place(p.y, chart.yAxis, range.y, count / 2)}`;
      if (!cells.has(cell)) cells.set(cell, p);
    }
    if (cells.size <= CROWD || count < 20) return new Set(cells.values());
  }
}

/* A value of an axis as a dashed line, or a range [from, to] as a shaded band, to null for the rest of the axis. */
function mark(chart, axis, name, value, range, shapes, annotations) {
  const other = axis === "x" ? "y" : "x";
  const log = axis === "x" ? chart.xAxis.log : chart.yAxis.log;
  const [from, to] = Array.isArray(value) ? value : [value, value];
  const limit = range[axis] ? (log ? 10 ** range[axis][1] : range[axis][1]) : from;
  const end = to === null ? limit : to;
  const at = { [axis + "0"]: from, [axis + "1"]: end, [other + "ref"]: "paper", [other + "0"]: 0, [other + "1"]: 1 };
  const band = { type: "rect", layer: "below", fillcolor: dark() ? "#ffffff14" : "#00000010", line: { width: 0 } };
  shapes.push({ ...(from === end ? { type: "line", line: { dash: "dash", width: 1, color: ink() } } : band), ...at });
  const place = axis === "x" ? { yref: "paper", y: 1, yanchor: "bottom" } : { xref: "paper", x: 1, xanchor: "right", yanchor: "bottom" };
  annotations.push({ ...place, [axis]: log ? Math.log10(from) : from, xanchor: from === end && axis === "x" ? "center" : axis === "x" ? "left" : "right",
    text: plotted(name), showarrow: false, font: { size: SMALL } });
}

/* A cross at the far edge for each point without a value, as in print. */
function crosses(chart, lost, range) {
  const edge = (axis, limits = [0, 1]) => {
    const at = limits[1] - 0.02 * (limits[1] - limits[0]);
    return axis.log ? 10 ** at : at;
  };
  return lost.map((p) => ({
    type: "scatter", mode: "markers", x: [hasNames(chart) ? edge(chart.xAxis, range.x) : coordinate(p.x)],
    y: [hasNames(chart) ? p.height : edge(chart.yAxis, range.y)], customdata: [p.row < 0 ? null : p.row],
    text: [hover(chart, p)], hovertemplate: "%{text}<extra></extra>",
    marker: { symbol: "x-thin", size: 7, line: { color: colour(chart, p.series), width: 1.5 } },
  }));
}

/* A line through the dots of each row of a dot plot. */
function joins(panel) {
  const rows = new Map();
  for (const point of [...panel.lines.values()].flat()) append(rows, point.y, point);
  return [...rows.values()].map((points) => ({ type: "scatter", mode: "lines", hoverinfo: "skip",
    x: points.map((p) => coordinate(p.x)), y: points.map(heightOf), line: { color: readable("#8a8a8a", MARK), width: 2 } }));
}

/* Colour and symbol are the estimator, so a backend is told by its name: beside points, or where those lines of one
   estimator are farthest apart that differ by more than can be seen. Names that would overlap share a place. */
function backendNames(chart, panel, joined, range) {
  const read = reader("rows", "backend");
  const every = [...panel.lines.values()].flat().filter((p) => p.row >= 0);
  if (!range.x || !range.y) return []; // an axis of names
  if (new Set(every.map((p) => read(p.row))).size < 2) return [];
  const groups = new Map();
  for (const p of every) {
    const [low, high] = groups.get(p.series + " " + p.x) || [p.y, p.y];
    groups.set(p.series + " " + p.x, [Math.min(low, p.y), Math.max(high, p.y)]);
  }
  const ratio = (p) => { const [low, high] = groups.get(p.series + " " + p.x); return Math.max(1, high / p.y, p.y / low); };
  const farthest = (points) => points.reduce((best, p) => (ratio(p) > ratio(best) ? p : best));
  const told = joined ? [...panel.lines.values()].map(farthest).filter((p) => ratio(p) > 1.03) : every;
  const scaled = (value, axis) => (axis.log ? Math.log10(value) : value);
  const near = (a, b, [low, high], share) => Math.abs(a - b) < share * (high - low);
  const names = [];
  for (const p of told.sort((one, other) => one.x - other.x)) {
    const [x, y, name] = [scaled(p.x, chart.xAxis), scaled(p.y, chart.yAxis), read(p.row)];
    const place = names.find((one) => near(one.x, x, range.x, 0.12) && near(one.y, y, range.y, 0.07));
    if (place) place.told.add(name);
    else names.push({ x, y, told: new Set([name]), color: readable(filling(chart, p.series), TEXT) });
  }
  return names.map(({ x, y, told: here, color }) => ({ x, y, xanchor: "left", xshift: 4, yanchor: "bottom",
    showarrow: false, text: plotted([...here].join(", ")), font: { size: SMALL, color } }));
}

function trace(chart, points, joined) {
  const look = looks(chart, points[0].series);
  const own = colour(chart, points[0].series);
  const symbol = points.some((p) => p.limit || p.leftLimit)
    ? points.map((p) => look.symbol + (p.limit || p.leftLimit ? "-open" : "")) : look.symbol;
  const made = {
    type: "scatter", mode: look.symbol === "line" ? "lines" : joined && look.dash !== "none" ? "lines+markers" : "markers", x: points.map((p) => coordinate(p.x)), y: points.map(heightOf),
    customdata: points.map((p) => (p.row < 0 ? null : p.row)), text: points.map((p) => hover(chart, p)), hovertemplate: "%{text}<extra></extra>",
    marker: { color: own, symbol, size: points.length > 500 ? 6 : 8,
      ...(joined ? {} : { line: { color: ground(), width: 1 } }) }, // an outline separates points that overlap
    line: { color: own, dash: look.dash, width: 1.5 },
  };
  const bars = (low, high, at, limit) => {
    const toTop = (p) => (p[low] !== null && chart.yAxis.log ? 1e9 * p[at] : 0); // an interval without an upper end
    const length = (p, end) => (p[limit] ? 0 : p[end] === null ? (end === high ? toTop(p) : 0) : Math.abs(p[end] - p[at]));
    return { type: "data", array: points.map((p) => length(p, high)), arrayminus: points.map((p) => length(p, low)),
      color: own, thickness: 1, width: 0 };
  };
  if (joined && chart.yAxis.high) made.error_y = bars("low", "high", "y", "limit");
  if (hasNames(chart) && chart.xAxis.high) made.error_x = bars("left", "right", "x", "leftLimit");
  return made;
}

const tellingColumns = page.columns.filter((column) => page.identity.includes(column.name) && !column.name.startsWith("estimator"));
const cellTexts = []; // per row that was drawn, a text that identifies its cell

function valueText(axis, value) {
  if (typeof value !== "number") return number(value);
  return axis.seconds ? duration(value) : axis.percent ? number(100 * value) + "%" : number(value);
}

function hover(chart, point) {
  const { xAxis, yAxis } = chart;
  const value = (axis, at, low, high, limit) => {
    const text = (value) => valueText(axis, value);
    const interval = low !== null && !limit ? ` [${text(low)}, ${high === null ? "no limit" : text(high)}]` : "";
    return `${axis.label ? plotted(axis.label) + ": " : ""}${limit ? "&lt; " : ""}${plotted(text(at))}${interval}`;
  };
  if (point.row >= 0 && !cellTexts[point.row]) cellTexts[point.row] = tellingColumns.map((c) => plotted(`${c.label} ${shownAs(c, point.row)}`)).join("<br>");
  return [`<b>${plotted(point.series)}</b>`, cellTexts[point.row] || "",
    value(xAxis, point.x, point.left, point.right, point.leftLimit),
    value(yAxis, point.y, point.low, point.high, point.limit)].filter(Boolean).join("<br>");
}

function rings(points, size, width, color) {
  return { type: "scatter", mode: "markers", x: points.map((p) => coordinate(p.x)), y: points.map(heightOf), hoverinfo: "skip",
    marker: { symbol: "circle-open", size, color, line: { width } } };
}

/* Per problem, the points that no other beats in both coordinates; joined where there are few problems. */
function frontTraces(panel, among) {
  const grey = dark() ? "#9aa3ab" : "#8a8a8a";
  const found = [];
  const all = [];
  for (const points of panel.fronts.values()) {
    let best = Infinity;
    const kept = [...points].sort((a, b) => a.x - b.x || a.y - b.y).filter((p) => p.y < best && ((best = p.y), true));
    all.push(...kept.filter((p) => !among || among.has(p)));
    if (panel.fronts.size > 3) continue;
    found.push({ type: "scatter", mode: "lines", x: kept.map((p) => p.x), y: kept.map((p) => p.y), hoverinfo: "skip",
      line: { shape: "hv", color: grey, width: 2 } });
  }
  return [...found, rings(all, 13, 1, grey)];
}

function frame(chart, panel, range) {
  const [x, y] = [chart.xAxis, chart.yAxis];
  const names = {}; // axes of names, in the order of the table
  if (isText(chart.table, x.column)) {
    const values = page.tables[chart.table][x.column] || page.tables.rows[x.column];
    const here = new Set([...[...panel.lines.values()].flat(), ...panel.lost].map((p) => p.x));
    names[x.column] = { type: "category", categoryarray: values.values.filter((name) => here.has(name)).map(plotted), tickfont: { size: SMALL } };
  }
  if (hasNames(chart)) {
    names[y.column] = { tickvals: [...panel.rows.values()], ticktext: [...panel.rows.keys()].map(plotted), tickfont: { size: SMALL },
      range: [panel.rows.size - 0.45, -0.55] };
  }
  const style = (axis, limits) => ({
    title: { text: plotted(axis.label), standoff: 6 }, type: axis.log ? "log" : "linear", range: limits, automargin: true,
    gridcolor: dark() ? "#363c43" : "#e3e6e9", zeroline: false, ...ticks(axis, limits), ...names[axis.column],
  });
  return { ...layout(), xaxis: style(x, range.x), yaxis: style(y, range.y) };
}

/* Ticks of a log axis: whole decades, or 1, 2 and 5 of each if there are few. */
function ticks(axis, limits) {
  if (!axis.log) return axis.percent ? { tickformat: ",.3~%" } : {};
  if (!limits) return {};
  const [first, last] = limits;
  const step = Math.max(1, Math.round((last - first) / 5));
  const within = last - first > 1.6 ? [1] : [1, 2, 5];
  const tickvals = [];
  for (let decade = Math.floor(first); decade <= last; decade++) {
    if (decade % step === 0) for (const k of within) tickvals.push(Number((k * 10 ** decade).toPrecision(3)));
  }
  const ticktext = tickvals.map((value) => valueText(axis, value).replace(/^1e(.*)$/, "10<sup>$1</sup>"));
  return { tickvals, ticktext };
}

function layout() {
  return {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", showlegend: false, margin: { l: 10, r: 14, t: 18, b: 10 },
    font: { family: "system-ui, sans-serif", size: SMALL, color: ink() }, hovermode: "closest",
    dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom", hoverlabel: { align: "left" },
  };
}

/* Maps: panels by name with their lines' places, sorted. */
function mapPanels(chart) {
  const [X, Y, level, facet, fill, cell] =
    [chart.xAxis.column, chart.yAxis.column, chart.level, chart.facet, chart.fill, chart.cell].map((name) =>
      name ? reader(chart.table, name) : () => "");
  const row = rowOf(chart.table);
  const panels = new Map();
  for (let i = 0, count = size(chart.table); i < count; i++) {
    if (!isShown(row(i)) || (chart.fill ? !fill(i) : !level(i))) continue;
    const name = facet(i) || "";
    if (!panels.has(name)) panels.set(name, { places: new Map(), names: new Set(), x: new Set(), y: new Set() });
    const panel = panels.get(name);
    const [x, y] = [exact(X(i)), exact(Y(i))];
    panel.x.add(x);
    panel.y.add(y);
    if (level(i)) panel.names.add(level(i));
    append(panel.places, JSON.stringify([x, y]), { row: row(i), level: level(i), fill: fill(i), cell: cell(i) });
  }
  return panels;
}

function mapFigure(chart, panel) {
  const names = Object.keys(chart.looks);
  const order = (axis, values) => {
    const column = page.tables[chart.table][axis.column] || page.tables.rows[axis.column];
    if (!column.index) return [...values].sort((a, b) => a - b);
    const known = column.values.filter((name) => values.has(name));
    return known.every((name) => isFinite(name)) ? known.sort((a, b) => a - b) : known;
  };
  const [xs, ys] = [order(chart.xAxis, panel.x), order(chart.yAxis, panel.y)];
  const at = (x, y) => panel.places.get(JSON.stringify([x, y]));
  const grid = (make) => ys.map((y) => xs.map((x) => (at(x, y) ? make(at(x, y), x, y) : null)));
  const worst = (found) => found.reduce((a, b) => (names.indexOf(b.level) > names.indexOf(a.level) ? b : a));
  const fill = (found) => worst(found).fill || filling(chart, worst(found).level);
  const letter = (found) => looks(chart, worst(found).level).letter || "";
  const isNarrow = 0.75 * chart.panels.clientWidth < NARROWEST * xs.length;
  const text = (found) => (chart.cell && !(isNarrow && letter(found)) ? worst(found).cell : letter(found));
  const label = (found, x, y) => [`<b>${plotted(worst(found).level || text(found))}</b>`,
    `${plotted(chart.xAxis.label)} ${plotted(x)}`, `${plotted(chart.yAxis.label)} ${plotted(y)}`,
    worst(found).row < 0 ? "" : plotted(reader("rows", "reason")(worst(found).row) || ""),
  ].filter(Boolean).join("<br>");
  const fills = [...new Set([...panel.places.values()].map(fill))];
  const made = {
    type: "heatmap", x: xs.map(plotted), y: ys.map(plotted), z: grid((found) => fills.indexOf(fill(found))), xgap: 1, ygap: 1,
    customdata: grid((found) => (worst(found).row < 0 ? null : worst(found).row)),
    hovertext: grid(label), hovertemplate: "%{hovertext}<extra></extra>", hoverongaps: false, showscale: false,
    colorscale: fills.flatMap((one, n) => [[n / fills.length, one], [(n + 1) / fills.length, one]]),
    zmin: -0.5, zmax: fills.length - 0.5,
  };
  // not the heat map's own text, whose colour has too little contrast on some cells
  const filled = ys.flatMap((y) => xs.map((x) => [x, y, at(x, y)])).filter(([, , found]) => found);
  const letters = {
    type: "scatter", mode: "text", x: filled.map(([x]) => plotted(x)), y: filled.map(([, y]) => plotted(y)), hoverinfo: "skip",
    text: filled.map(([, , found]) => text(found)), textfont: { color: filled.map(([, , found]) => inkOn(fill(found))) },
  };
  const axis = (from) => ({ title: { text: plotted(from.label), standoff: 6 }, type: "category", automargin: true, showgrid: false });
  const downwards = isText(chart.table, chart.yAxis.column) ? { autorange: "reversed" } : {};
  return [[made, letters], { ...layout(), xaxis: axis(chart.xAxis), yaxis: { ...axis(chart.yAxis), ...downwards } }];
}

// -------------------------------------------------------------------------------------------------------- table

const [head, body] = document.querySelectorAll("#table thead, #table tbody");

function buildTable() {
  head.append(element("tr", {}, ...page.columns.map((column) => {
    const button = element("button", { type: "button", textContent: column.label });
    button.addEventListener("click", () => sortBy(column.name));
    return element("th", { scope: "col", className: column.kind === "text" ? "" : "number" }, button);
  })));
  document.getElementById("unsteady").hidden = !page.columns.some((column) => column.kind === "seconds" && column.flag);
  document.getElementById("more").addEventListener("click", () => { state.limit += MORE; drawTable(); });
  body.addEventListener("click", (event) => {
    const line = event.target.closest("tr");
    if (line && !getSelection().toString()) select(Number(line.dataset.row));
  });
  body.addEventListener("keydown", (event) => {
    const line = event.target.closest("tr");
    const next = { ArrowDown: line.nextElementSibling, ArrowUp: line.previousElementSibling }[event.key];
    if (next) next.focus();
    if (event.key === "Enter" || event.key === " ") select(Number(line.dataset.row));
    if (next || event.key === " ") event.preventDefault();
  });
}

function sortBy(name) {
  const again = state.sort && state.sort.name === name;
  state.sort = { name, up: again ? !state.sort.up : true };
  page.columns.forEach((column, k) => {
    const mine = column.name === name;
    if (mine) head.rows[0].cells[k].ariaSort = state.sort.up ? "ascending" : "descending";
    else head.rows[0].cells[k].removeAttribute("aria-sort");
  });
  drawTable();
}

function order() {
  const found = [];
  for (let i = 0; i < rowCount; i++) if (visible[i]) found.push(i);
  if (!state.sort) return found;
  const read = reader("rows", state.sort.name);
  const sign = state.sort.up ? 1 : -1;
  const values = found.map((i) => [read(i), i]);
  values.sort(([a, i], [b, j]) => {
    if (a === b) return i - j;
    if (a === null || b === null) return a === null ? 1 : -1; // missing values come last in both orders
    return sign * (a < b ? -1 : 1);
  });
  return values.map(([, i]) => i);
}

function drawTable() {
  const found = order();
  const status = reader("rows", "status");
  body.replaceChildren(...found.slice(0, state.limit).map((i) => {
    const line = element("tr", { tabIndex: 0, ariaSelected: String(i === state.selected) }, ...page.columns.map((column) => {
      const cell = element("td", { textContent: shownAs(column, i), className: column.kind === "text" ? "" : "number" });
      if (column.name === "status" && status(i) !== "ok") cell.className = "failed";
      if (column.name === "reason") cell.className = "reason";
      return cell;
    }));
    line.dataset.row = i;
    line.className = reader("rows", "status")(i) || "";
    return line;
  }));
  const more = document.getElementById("more");
  more.hidden = found.length <= state.limit;
  more.textContent = `Show more (${Math.min(state.limit, found.length)} of ${found.length} shown)`;
}

// --------------------------------------------------------------------------------------------- the selected cell

function select(row) {
  state.selected = row;
  for (const line of body.rows) line.ariaSelected = String(Number(line.dataset.row) === row);
  markDirty();
  const cell = document.getElementById("cell");
  cell.hidden = row < 0;
  if (row < 0) return;
  const close = element("button", { type: "button", textContent: "Close" });
  close.addEventListener("click", () => {
    select(-1);
    const line = body.querySelector(`tr[data-row="${row}"]`);
    if (line) line.focus({ preventScroll: true });
  });
  const fact = (label, value) => element("div", {}, element("dt", { textContent: label }), element("dd", { textContent: value }));
  const identity = page.identity.map((name) => [name, reader("rows", name)(row)])
    .filter(([, value]) => value !== null && value !== "" && value !== "none");
  const results = page.columns.filter((column) => !page.identity.includes(column.name) && column.name !== "reason");
  const reason = reader("rows", "reason")(row);
  const failed = reader("rows", "status")(row) !== "ok";
  const command = commandOf(row);
  cell.replaceChildren(
    element("div", { className: "top" }, element("h2", { textContent: "The selected cell" }), close),
    ...(reason ? [element("p", { className: failed ? "failed" : "hint", textContent: reason })] : []),
    ...(command ? [element("p", { textContent: "To run only this cell again, with the same numbers:" }), copyable(command)] : []),
    ...(!command && page.command.words.length ? [element("p", { textContent: GONE })] : []),
    element("dl", {}, ...identity.map(([name, value]) => fact(name.replace(/_/g, " "), exact(value))),
      ...results.map((column) => fact(column.label, shownAs(column, row)))),
  );
  cell.focus({ preventScroll: true });
}

function commandOf(row) {
  const words = page.command.words.map((column) => column.values[column.index[row]]).filter(Boolean);
  return words.length ? [page.command.head, ...words].join(" ") : "";
}

function copyable(text) {
  const code = element("pre", { textContent: text, id: "command", tabIndex: 0 });
  const button = element("button", { type: "button", textContent: "Copy" });
  button.addEventListener("click", () => {
    getSelection().selectAllChildren(code);
    button.textContent = document.execCommand("copy") ? "Copied" : "Press Ctrl+C";
  });
  return element("div", {}, code, button);
}

// --------------------------------------------------------------------------------------------------------- theme

function applyTheme(theme) {
  state.theme = theme;
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
  document.getElementById("theme").textContent = `Theme: ${theme}`;
  markDirty();
}

function buildTheme() {
  const next = { auto: "dark", dark: "light", light: "auto" };
  document.getElementById("theme").addEventListener("click", () => applyTheme(next[state.theme]));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", markDirty);
  let before = state.theme;
  addEventListener("beforeprint", () => {
    before = state.theme;
    document.documentElement.dataset.printing = "";
    applyTheme("light");
    for (const chart of charts) if (chart.dirty) drawChart(chart);
    fitCharts();
    document.querySelector("#made details").open = true;
  });
  addEventListener("afterprint", () => {
    delete document.documentElement.dataset.printing;
    fitCharts();
    applyTheme(before);
  });
}

/* At once: Plots.resize waits, and paper does not. */
function fitCharts() {
  for (const plot of document.querySelectorAll(".plot")) if (plot.data) Plotly.relayout(plot, { autosize: true });
}

// --------------------------------------------------------------------------------------------------------- start

/* When the charts in sight are drawn; until the browser has said which these are, near is undefined. */
async function settled() {
  do await new Promise(requestAnimationFrame);
  while (charts.some((chart) => chart.near === undefined || (chart.near && chart.dirty)));
}

async function start() {
  buildTheme();
  buildFilters();
  buildTable();
  if (location.hash) fromAddress();
  else refresh();
  buildCharts();
  markDirty();
  await settled();
  document.documentElement.dataset.loaded = performance.now().toFixed(0);
}

start();
