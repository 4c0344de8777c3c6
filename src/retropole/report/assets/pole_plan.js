"use strict";
// The page of a plan has no view. On paper, what is folded is open.
setUpPage(() => {});
setUpPaper("details");
root.dataset.usable = String(Math.round(performance.now()));
