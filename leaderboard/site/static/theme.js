// Light or dark: as the system says, or as the reader chose; shared with the documentation.
(() => {
  "use strict";
  const KEY = "symsteer-theme";
  const system = matchMedia("(prefers-color-scheme: dark)");
  const stored = () => {
    try { return localStorage.getItem(KEY); } catch { return null; }
  };
  const store = (theme) => {
    try { theme ? localStorage.setItem(KEY, theme) : localStorage.removeItem(KEY); } catch { /* not kept */ }
  };
  const bySystem = () => (system.matches ? "dark" : "light");
  const apply = () => {
    const theme = stored() || bySystem();
    const root = document.documentElement;
    root.dataset.theme = theme;
    root.classList.toggle("dark", theme === "dark");
    for (const button of document.querySelectorAll("[data-switch-theme]")) {
      const label = theme === "dark" ? "Use light colours" : "Use dark colours";
      button.setAttribute("aria-label", label);
      button.title = label;
    }
    document.dispatchEvent(new CustomEvent("themechange", { detail: theme }));
  };
  // What only scripts can use is shown, and long tables wait until they have pages.
  document.documentElement.classList.add("scripted");
  apply();
  system.addEventListener("change", apply);
  addEventListener("storage", (event) => { if (event.key === KEY) apply(); });
  document.addEventListener("DOMContentLoaded", apply);
  document.addEventListener("click", (event) => {
    if (!event.target.closest?.("[data-switch-theme]")) return;
    const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
    // The system's own choice is not stored, so that the page follows the system again.
    store(next === bySystem() ? null : next);
    apply();
  });
})();
