// Names for the buttons of the theme that open a list of pages, which screen readers need.
document.addEventListener("DOMContentLoaded", () => {
  for (const toggle of document.querySelectorAll("summary:has(> .toctree-toggle)")) {
    toggle.setAttribute("aria-label", "Pages below");
  }
});
