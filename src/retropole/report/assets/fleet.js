"use strict";
// The page of a fleet has no view. On paper, its colours are light, and what is folded is open.
setUpPage(() => {});
let before = null;
addEventListener("beforeprint", () => {
  before ||= { theme: root.dataset.theme, folded: all("details:not([open])") };
  root.dataset.theme = "light";
  for (const part of before.folded) part.open = true;
});
addEventListener("afterprint", () => {
  if (!before) return;
  for (const part of before.folded) part.open = false;
  if (before.theme) root.dataset.theme = before.theme; else delete root.dataset.theme;
  before = null;
});
root.dataset.usable = String(Math.round(performance.now()));
