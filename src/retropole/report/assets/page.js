"use strict";
// What every page has: copying, tables that scroll, light and dark, and a view that takes pointer and keys.

const $ = (selector) => document.querySelector(selector);
const all = (selector) => [...document.querySelectorAll(selector)];
const root = document.documentElement;

function colour(name) {
  const text = getComputedStyle(root).getPropertyValue(name).trim();
  return [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16));
}

// Chromium rounds the scale of a canvas on paper down to 1/64 of a pixel: of these sizes, next to
// those of the style, hardly anything is lost. Others leave a blank edge, or stretch the picture.
const PAPER = { width: 1000, height: 540, dpr: 2, panel: { width: 316, height: 237 } };

/** Set up copying, tables, the certificate and the theme: they work even where the view does not. */
function setUpPage(repaint) {
  async function copy(pre) {
    try {
      await navigator.clipboard.writeText(pre.textContent);
      return true;
    } catch {
      const range = document.createRange();
      range.selectNodeContents(pre);
      getSelection().removeAllRanges();
      getSelection().addRange(range);
      return document.execCommand("copy");
    }
  }
  all(".copy-button").forEach((button) => button.addEventListener("click", async () => {
    button.textContent = (await copy(button.closest(".copy").querySelector("pre"))) ? "Copied" : "Selected: press Ctrl+C";
    setTimeout(() => { button.textContent = "Copy"; }, 1600);
  }));

  // Where a table is wider than its place, its caption states that it scrolls.
  const sizes = new ResizeObserver((entries) => entries.forEach(({ target }) => {
    const box = target.closest(".scroll");
    box.toggleAttribute("data-scrolls", box.scrollWidth > box.clientWidth + 1);
  }));
  all(".scroll, .scroll > table").forEach((part) => sizes.observe(part));

  $("#print-certificate")?.addEventListener("click", () => {
    root.dataset.print = "certificate";
    print();
  });
  addEventListener("afterprint", () => { delete root.dataset.print; });

  const prefersDark = matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : prefersDark.matches);
  function nameTheme() { $("#theme").textContent = isDark() ? "Light" : "Dark"; $("#theme").setAttribute("aria-label", `Switch to ${isDark() ? "light" : "dark"} colours`); }
  $("#theme").addEventListener("click", () => { root.dataset.theme = isDark() ? "light" : "dark"; nameTheme(); repaint(); });
  prefersDark.addEventListener("change", () => { nameTheme(); repaint(); });
  nameTheme();
}

/** On paper, colours are light and what a selector finds is unfolded; `draw` and `redraw` are those of a view. */
function setUpPaper(unfolded, draw = () => {}, redraw = () => {}) {
  let before = null;
  addEventListener("beforeprint", () => {
    before ||= { theme: root.dataset.theme, folded: all(`${unfolded}:not([open])`) };
    root.dataset.theme = "light";
    for (const part of before.folded) part.open = true;
    draw();
  });
  addEventListener("afterprint", () => {
    if (!before) return;
    for (const part of before.folded) part.open = false;
    if (before.theme) root.dataset.theme = before.theme; else delete root.dataset.theme;
    before = null;
    redraw();
  });
}

/** Let the view take the wheel, fingers and arrow keys, from when it has been clicked, tapped or focused. */
function handOver(view, repaint) {
  const marks = $("#marks");
  // The wheel and the finger scroll the page until the view has been clicked, tapped or focused.
  const coarse = matchMedia("(pointer: coarse)").matches;
  const turn = view.kind === "webgl" ? "rotate" : "move";
  const hints = coarse
    ? [`Tap to ${turn} the view; a finger scrolls the page`, `Drag to ${turn}, pinch to zoom; tap outside the view to scroll again`]
    : [`Drag to ${turn}; click, then wheel to zoom`, ""];
  function activate(on) {
    view.allowWheel(on);
    marks.style.touchAction = on ? "none" : "manipulation";
    root.dataset.active = on ? "view" : "";
    $("#hint").textContent = hints[on ? 1 : 0];
    $("#hint").hidden = !$("#hint").textContent;
  }
  activate(false);
  $(".stage").addEventListener("pointerdown", (e) => {
    if (e.pointerType === "touch") { if (!root.dataset.active) e.stopPropagation(); } else marks.focus({ preventScroll: true });
  }, true);
  marks.addEventListener("click", () => marks.focus({ preventScroll: true }));
  marks.addEventListener("focus", () => activate(true));
  marks.addEventListener("blur", () => activate(false));
  document.addEventListener("pointerdown", (e) => { if (!e.target.closest(".stage")) marks.blur(); });

  const orbits = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
  marks.addEventListener("keydown", (e) => {
    if (e.key in orbits) view.orbit(...orbits[e.key]);
    else if (e.key === "+" || e.key === "=") view.zoom(1 / 1.15);
    else if (e.key === "-") view.zoom(1.15);
    else if (e.key === "Home") view.preset("oblique");
    else return;
    e.preventDefault();
    repaint();
  });
}
