"use strict";
// The page of a plan has no view. On paper, folded parts are shown.
setUpPage(() => {});
setUpPaper("details");
root.dataset.usable = String(Math.round(performance.now()));
