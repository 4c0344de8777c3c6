"use strict";
// The page of a fleet has no view: what is folded is on paper all the same.
setUpPage(() => {});
let folded = [];
addEventListener("beforeprint", () => {
  folded = all("details:not([open])");
  for (const part of folded) part.open = true;
});
addEventListener("afterprint", () => { for (const part of folded) part.open = false; });
root.dataset.usable = String(Math.round(performance.now()));
