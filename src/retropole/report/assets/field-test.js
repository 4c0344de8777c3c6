"use strict";
// The page of the field test: tables alone.

setUpPage(() => {});
root.dataset.usable = String(Math.round(performance.now()));
