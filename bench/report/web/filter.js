/* Radio buttons in [data-filter] choose which elements with [data-group] are shown: those of the chosen group, or all.
   A section or an entry of the contents without any element left is hidden too. */
"use strict";

const filter = document.querySelector("[data-filter]");
const grouped = [...document.querySelectorAll("[data-group]")];

function applyFilter() {
  const chosen = filter.querySelector("input:checked").value;
  for (const one of grouped) one.hidden = chosen !== "" && one.dataset.group !== chosen;
  for (const section of document.querySelectorAll("main section, .contents > li")) {
    const own = [...section.querySelectorAll("[data-group]")];
    section.hidden = own.length > 0 && own.every((one) => one.hidden);
  }
}

/* A link to a hidden element shows everything. */
function showTarget() {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target || !target.closest("[hidden]")) return;
  filter.querySelector('input[value=""]').checked = true;
  applyFilter();
  target.scrollIntoView();
}

if (filter) {
  filter.hidden = false; // without this script it would do nothing
  filter.addEventListener("change", applyFilter);
  addEventListener("hashchange", showTarget);
  applyFilter();
}
