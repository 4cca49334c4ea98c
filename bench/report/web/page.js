/* The table of a page's cells: filters, order, and the selected cell with the command that runs it.

   The cells in #data are columns by name: a list of numbers (null where there is none), or texts as {values, index}.
   Texts reach the page only through textContent, so that none is taken for HTML. */
"use strict";

const page = JSON.parse(document.getElementById("data").textContent);
const FIRST = 60, MORE = 240; // rows of the table at first, and with every "Show more"
const state = { find: "", sort: null, limit: FIRST, selected: -1 };
const place = (id) => document.getElementById(id);
const [head, body] = document.querySelectorAll("#table thead, #table tbody");
const answer = page.columns.find((column) => !page.identity.includes(column.name)); // stays in sight on a phone
const every = Array.from({ length: page.count }, (_, i) => i);
let shown = every;

/* A function from the index of a cell to its value in a column. */
const readers = Object.fromEntries(Object.entries(page.cells).map(([name, column]) =>
  [name, column.index ? (i) => column.values[column.index[i]] : (i) => column[i]]));

const classOf = (column) => (column.kind === "text" ? column.name : "number") + (column === answer ? " answer" : "");

function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function button(textContent, action) {
  const made = element("button", { type: "button", textContent });
  made.addEventListener("click", action);
  return made;
}

// ------------------------------------------------------------------------------------------------------ numbers

function number(value) {
  const size = Math.abs(value);
  if (size === 0 || (size >= 1e-3 && size < 1e5)) return String(Number(value.toPrecision(3)));
  return value.toExponential(2).replace(/\.?0+e/, "e").replace("e+", "e");
}

function exact(value) {
  if (value === null) return "-";
  const size = Math.abs(value);
  if (typeof value !== "number" || size === 0 || (size >= 1e-3 && size < 1e5)) return String(value);
  return value.toExponential().replace("e+", "e");
}

function duration(seconds) {
  if (seconds < 0.9995e-3) return number(seconds * 1e6) + " µs";
  return seconds < 0.9995 ? number(seconds * 1e3) + " ms" : number(seconds) + " s";
}

function shownAs(column, i) {
  const value = readers[column.name](i);
  if (typeof value !== "number" || page.identity.includes(column.name)) return exact(value);
  const flagged = column.flag && readers[column.flag](i);
  if (column.kind === "seconds") return duration(value) + (flagged ? " !" : "");
  return (flagged ? "< " : "") + number(value);
}

// ------------------------------------------------------------------------------------------------------ filters

const boxes = page.filters.map((name) => {
  const counts = new Map();
  for (const i of every) counts.set(readers[name](i), (counts.get(readers[name](i)) || 0) + 1);
  const values = [...counts.keys()];
  if (values.some((value) => typeof value === "number")) values.sort((a, b) => a - b);
  const inputs = values.map((value) => element("input", { type: "checkbox", checked: true, value: String(value) }));
  const set = (checked) => () => { for (const input of inputs) input.checked = checked; refresh(); };
  const labels = values.map((value, k) => element("label", {}, inputs[k],
    element("span", { textContent: value === "" ? "(default)" : exact(value) }),
    element("small", { textContent: counts.get(value) })));
  const summary = element("summary");
  const details = element("details", {}, summary,
    element("fieldset", { ariaLabel: name }, button("all", set(true)), button("none", set(false)), ...labels));
  details.dataset.column = name;
  return { name, values, inputs, summary, details };
});

/* The values of a filter that are kept; null if all are. */
function keptOf(box) {
  const kept = box.values.filter((_, k) => box.inputs[k].checked);
  return kept.length === box.values.length ? null : kept;
}

const searched = (i) => page.columns.map((column) => shownAs(column, i)).join(" ").toLowerCase();

function refresh() {
  const tests = [];
  for (const box of boxes) {
    const kept = keptOf(box);
    box.details.classList.toggle("active", kept !== null);
    box.summary.textContent = box.name.replace(/_/g, " ") + (kept ? ` ${kept.length}/${box.values.length}` : "");
    if (kept) tests.push([readers[box.name], new Set(kept)]);
  }
  shown = every.filter((i) => tests.every(([read, kept]) => kept.has(read(i))) && (!state.find || searched(i).includes(state.find)));
  place("shown").textContent = `${shown.length} of ${page.count} cells shown`;
  toAddress();
  state.limit = FIRST;
  drawTable();
}

/* The address keeps the filters, #estimator=fobg,reinforce&find=jax, so that a link shows what its sender saw. */
let written = "";

function toAddress() {
  const parts = boxes.filter(keptOf).map((box) => [box.name, keptOf(box)]);
  if (state.find) parts.push(["find", [state.find]]);
  const texts = parts.map(([name, kept]) => encodeURIComponent(name) + "=" + kept.map(encodeURIComponent).join(","));
  written = texts.length ? "#" + texts.join("&") : "";
  if (location.hash !== written) history.replaceState(null, "", written || location.pathname + location.search);
}

function fromAddress() {
  const given = new Map();
  for (const part of location.hash.slice(1).split("&")) {
    const [name, ...rest] = part.split("=");
    try {
      given.set(decodeURIComponent(name), rest.join("=").split(",").map(decodeURIComponent));
    } catch { /* not an address that this page wrote */ }
  }
  state.find = place("find").value = (given.get("find") || []).join(",");
  for (const box of boxes) {
    const kept = given.get(box.name);
    for (const input of box.inputs) input.checked = !kept || kept.includes(input.value);
  }
  refresh();
}

/* The cells shown, in the order of the table, every digit that the page has. */
function csv() {
  const names = [...new Set([...page.identity, ...page.columns.map((column) => column.name)])];
  const quoted = (value) => {
    const text = value === null ? "" : String(value);
    return /[",\r\n]/.test(text) ? '"' + text.replace(/"/g, '""') + '"' : text;
  };
  return [names, ...ordered().map((i) => names.map((name) => readers[name](i)))]
    .map((line) => line.map(quoted).join(",") + "\n").join("");
}

function saveCsv() {
  const address = URL.createObjectURL(new Blob([csv()], { type: "text/csv" }));
  element("a", { href: address, download: document.title.replace(/\W+/g, "_") + ".csv" }).click();
  setTimeout(() => URL.revokeObjectURL(address), 1000);
}

// -------------------------------------------------------------------------------------------------------- table

function sortBy(name) {
  state.sort = { name, up: !(state.sort && state.sort.name === name && state.sort.up) };
  page.columns.forEach((column, k) => {
    if (column.name === name) head.rows[0].cells[k].ariaSort = state.sort.up ? "ascending" : "descending";
    else head.rows[0].cells[k].removeAttribute("aria-sort");
  });
  drawTable();
}

function ordered() {
  if (!state.sort) return shown;
  const read = readers[state.sort.name], sign = state.sort.up ? 1 : -1;
  return [...shown].sort((i, j) => {
    const [a, b] = [read(i), read(j)];
    if (a === b) return i - j;
    if (a === null || b === null) return a === null ? 1 : -1; // missing values come last in both orders
    return sign * (a < b ? -1 : 1);
  });
}

function drawTable() {
  body.replaceChildren(...ordered().slice(0, state.limit).map((i) => {
    const cells = page.columns.map((column) => element("td", { textContent: shownAs(column, i), className: classOf(column) }));
    const line = element("tr", { tabIndex: 0, ariaSelected: String(i === state.selected), className: readers.status(i) }, ...cells);
    line.dataset.row = i;
    return line;
  }));
  place("more").hidden = shown.length <= state.limit;
  place("more").textContent = `Show more (${Math.min(state.limit, shown.length)} of ${shown.length} shown)`;
}

// --------------------------------------------------------------------------------------------- the selected cell

function select(row) {
  state.selected = row;
  for (const line of body.rows) line.ariaSelected = String(Number(line.dataset.row) === row);
  place("cell").hidden = row < 0;
  if (row < 0) return;
  const close = button("Close", () => {
    select(-1);
    const line = body.querySelector(`tr[data-row="${row}"]`);
    if (line) line.focus({ preventScroll: true });
  });
  const identity = page.identity.map((name) => [name.replace(/_/g, " "), exact(readers[name](row))]);
  const results = page.columns.filter((column) => !page.identity.includes(column.name) && column.name !== "reason")
    .map((column) => [column.label, shownAs(column, row)]);
  const facts = [...identity.filter(([, value]) => !["-", "", "none"].includes(value)), ...results].map(([label, value]) =>
    element("div", {}, element("dt", { textContent: label }), element("dd", { textContent: value })));
  const failed = readers.status(row) !== "ok";
  place("cell").replaceChildren(
    element("div", { className: "top" }, element("h2", { textContent: "The selected cell" }), close),
    element("p", { className: failed ? "failed" : "hint", textContent: readers.reason(row) }),
    ...command(row),
    element("dl", {}, ...facts),
  );
  place("cell").focus({ preventScroll: true });
}

function command(row) {
  const words = page.command.words.map((column) => column.values[column.index[row]]).filter(Boolean);
  if (!page.command.words.length) return [];
  if (!words.length) return [element("p", { textContent: "The experiment, as configured when this page was written, has no such cell any more." })];
  const code = element("pre", { textContent: [page.command.head, ...words].join(" "), id: "command", tabIndex: 0 });
  const copy = button("Copy", () => {
    getSelection().selectAllChildren(code);
    copy.textContent = document.execCommand("copy") ? "Copied" : "Press Ctrl+C";
  });
  return [element("p", { textContent: "To run only this cell again, with the same numbers:" }), code, copy];
}

// --------------------------------------------------------------------------------------------------------- start

place("filters").append(...boxes.map((box) => box.details));
place("filters").addEventListener("change", refresh);
place("find").addEventListener("input", (event) => { state.find = event.target.value.trim().toLowerCase(); refresh(); });
place("clear").addEventListener("click", () => { history.replaceState(null, "", "#"); fromAddress(); });
place("csv").addEventListener("click", saveCsv);
place("more").addEventListener("click", () => { state.limit += MORE; drawTable(); });
place("unsteady").hidden = !page.columns.some((column) => column.kind === "seconds" && column.flag);
head.append(element("tr", {}, ...page.columns.map((column) =>
  element("th", { scope: "col", className: classOf(column) }, button(column.label, () => sortBy(column.name))))));
document.addEventListener("click", (event) => {
  for (const { details } of boxes) if (!details.contains(event.target)) details.open = false;
});
document.addEventListener("keydown", (event) => {
  for (const { details, summary } of boxes) if (event.key === "Escape" && details.open) { details.open = false; summary.focus(); }
});
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
addEventListener("hashchange", () => { if (location.hash !== written) fromAddress(); });
addEventListener("beforeprint", () => { document.querySelector("#made details").open = true; });
fromAddress();
