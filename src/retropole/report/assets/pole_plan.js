"use strict";
// The page of a plan: poles that move to where they could stand, with what that does to the error.
(() => {
  setUpPage(() => {});
  setUpPaper("details");
  const plan = JSON.parse($("#data").textContent);

  // --- what predicts the error ---

  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const floats = (text) => new Float32Array(bytes(text).buffer);
  function bits(text, width) {
    const packed = bytes(text);
    return (row, column) => { const at = row * width + column; return (packed[at >> 3] >> (7 - (at & 7))) & 1; };
  }

  /** Unpack the roots: of each pole its columns, one behind the other. */
  function unpack(packed) {
    const { size, ranks } = packed, scales = floats(packed.scales), steps = new Int16Array(bytes(packed.roots).buffer);
    let from = 0;
    const roots = ranks.map((rank) => {
      const root = new Float64Array(rank * size);
      for (let k = 0; k < root.length; k++) root[k] = steps[from * size + k] * scales[from + Math.floor(k / size)];
      from += rank;
      return root;
    });
    return { size, roots, rows: floats(packed.rows), rest: packed.rest };
  }
  const models = [unpack(plan.together), unpack(plan.alone)];

  /** Add what a pole says, root rootᵀ, to the lower half of a matrix. */
  function add(total, root, size) {
    for (let from = 0; from < root.length; from += size) {
      for (let i = 0; i < size; i++) {
        const value = root[from + i];
        for (let j = 0; j <= i; j++) total[i * size + j] += value * root[from + j];
      }
    }
  }

  function sumOf(model, poles) {
    const total = new Float64Array(model.size ** 2);
    for (let i = 0; i < model.size; i++) total[i * model.size + i] = 1;
    for (const k of poles) add(total, model.roots[k], model.size);
    return total;
  }

  /** 1 σ of each LiDAR but the first: by the root of Cholesky, in place. */
  function errorsOf(model, total) {
    const { size, rows, rest } = model;
    for (let i = 0; i < size; i++) {
      for (let j = 0; j <= i; j++) {
        let left = total[i * size + j];
        for (let k = 0; k < j; k++) left -= total[i * size + k] * total[j * size + k];
        total[i * size + j] = i === j ? Math.sqrt(Math.max(left, 1e-12)) : left / total[j * size + j];
      }
    }
    const solved = new Float64Array(size);
    return rest.map((constant, lidar) => {
      let square = constant;
      for (let row = 0; row < 6; row++) {
        const from = (6 * lidar + row) * size;
        for (let i = 0; i < size; i++) {
          let left = rows[from + i];
          for (let k = 0; k < i; k++) left -= total[i * size + k] * solved[k];
          solved[i] = left / total[i * size + i];
          square += solved[i] ** 2;
        }
      }
      return Math.sqrt(square);
    });
  }

  // What the page predicts of the plan itself is what the plan states: changes are in proportion.
  const own = plan.chosen.flat();
  const planned = models.map((model) => errorsOf(model, sumOf(model, own)));
  const worst = (errors, m) => Math.max(...errors.map((error, k) => error * plan.stated[m][k] / planned[m][k]));
  const stated = plan.stated.map((each) => Math.max(...each));

  // --- poles and places ---

  const seen = bits(plan.seen, plan.lidars.length), together = bits(plan.pairs, plan.foot.length);
  const names = plan.names.flat(), placementOf = plan.names.flatMap((each, p) => each.map(() => p));
  const every = plan.foot.map((_, k) => k);
  const along = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const apart = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
  const leansAlike = (k) => every.filter((other) => along(plan.axis[k], plan.axis[other]) > 0.9999);
  const standsThere = (k) => every.filter((other) => apart(plan.foot[k], plan.foot[other]) < 0.01);
  const inPlace = ([x, y]) => [
    plan.width / 2 - plan.scale * (y - plan.middle[1]), plan.height / 2 - plan.scale * (x - plan.middle[0]),
  ];
  const where = plan.foot.map(inPlace);
  const now = [...own];
  let chosen = 0;
  /** Size of the marks: smaller where the picture is larger. */
  let size = 1;

  const leanOf = (k) => Math.acos(Math.min(1, Math.abs(plan.axis[k][2])));
  const others = (p) => now.map((_, q) => q).filter((q) => q !== p && placementOf[q] === placementOf[p]);
  const seers = (k) => plan.lidars.map((_, i) => i).filter((i) => seen(k, i));

  /** Why two poles of a placement may not stand so; empty where they may. */
  function against(a, b, j, k) {
    if (apart(plan.foot[j], plan.foot[k]) < plan.spacing) return `${a} and ${b} stand nearer to each other than ${plan.spacing} m.`;
    const turn = Math.acos(Math.min(1, Math.abs(along(plan.axis[j], plan.axis[k]))));
    if (turn < plan.angle - 1e-6) return `${a} and ${b} point almost the same way: at least ${degrees(plan.angle)} must lie between them.`;
    if (!together(j, k)) {
      const both = seers(j).filter((i) => seen(k, i));
      return both.length < 2 ? `No two LiDARs see both ${a} and ${b}.` : `${a} and ${b} stand in one line with a LiDAR: one may hide the other.`;
    }
    if (plan.names[placementOf[names.indexOf(a)]].length <= 3 && Math.abs(leanOf(j) - leanOf(k)) < plan.lean) {
      return `${a} and ${b} lean by the same angle: nothing tells which is which.`;
    }
    return "";
  }
  const degrees = (angle) => `${Math.round(angle * 180 / Math.PI)}°`;

  function warnings() {
    const found = [];
    now.forEach((k, p) => {
      others(p).filter((q) => q < p).forEach((q) => found.push(against(names[q], names[p], now[q], k)));
      const lost = seers(own[p]).filter((i) => !seen(k, i)).map((i) => plan.lidars[i]);
      if (lost.length) found.push(`${lost.join(" and ")} would not see ${names[p]} there.`);
    });
    return found.filter(Boolean);
  }

  /** Two significant digits, as everywhere else on the page. */
  function error(metres) {
    const [scale, unit] = metres < 0.0995 ? [1000, "mm"] : [1, "m"];
    const rounded = Number((metres * scale).toPrecision(2));
    return `${rounded.toFixed(Math.max(0, 1 - Math.floor(Math.log10(rounded))))} ${unit}`;
  }

  // --- the picture and the words ---

  const picture = $("#picture"), spots = $("#picture .spots"), svg = "http://www.w3.org/2000/svg";
  /** What a pole covers from above, lengthened so that it is seen. */
  function way(axis, size) {
    const covered = plan.scale * plan.length * Math.hypot(axis[0], axis[1]);
    const factor = covered > 1 ? plan.scale * plan.length * Math.max(covered / size, plan.stroke) / covered : 0;
    return [-factor * axis[1], -factor * axis[0]];
  }
  const written = (selector, text) => all(selector).forEach((part) => { part.textContent = text; });

  function drawPole(p) {
    const k = now[p];
    for (const part of all(`[data-pole="${p}"]`)) {
      const factor = picture.contains(part) ? size : 1;
      part.setAttribute("transform", `translate(${where[k].map((each) => each.toFixed(1)).join(" ")}) scale(${factor})`);
      const [dx, dy] = way(plan.axis[k], factor);
      part.querySelector(".leaning").setAttribute("d", `M0 0L${dx.toFixed(1)} ${dy.toFixed(1)}`);
      part.querySelector(".top").setAttribute("cx", dx.toFixed(1));
      part.querySelector(".top").setAttribute("cy", dy.toFixed(1));
      if (picture.contains(part)) part.setAttribute("aria-label", `Pole ${names[p]}: ${plan.words[k]}`);
    }
    written(`[data-words="${p}"]`, plan.words[k]);
    const lean = $(`[data-lean="${p}"]`);
    lean.replaceChildren(...standsThere(k).map((other) => {
      // A list is narrow; the sentence above it names the LiDAR, one for all leans of a place.
      const parts = /^(away|towards)(?: from)? .*?(?:, (\d+)° to the (left|right) as seen from there)?$|^to the (left|right) /.exec(plan.towards[other]);
      const way = parts && [parts[1] ?? parts[4], ...(parts[2] ? [`${parts[2]}° ${parts[3]}`] : [])].join(", ");
      const words = way ? `${degrees(leanOf(other))} ${way}` : "upright";
      return new Option(words, other, other === k, other === k);
    }));
    lean.disabled = lean.options.length < 2;
  }

  /** Lengths to measure: from below the nearest two LiDARs, and from the feet of other poles. */
  function tapeOf(inPlacement) {
    const at = (i) => plan.foot[now[names.indexOf(inPlacement[i])]];
    return inPlacement.flatMap((end, j) => {
      const lengths = plan.at.map((lidar, i) => ({ start: `below ${plan.lidars[i]}`, end, metres: apart(at(j), lidar) }));
      const nearest = lengths.sort((a, b) => a.metres - b.metres).slice(0, 2);
      for (let i = 0; i < j; i++) nearest.push({ start: inPlacement[i], end, metres: Math.hypot(...at(j).map((each, m) => each - at(i)[m])) });
      return nearest;
    });
  }

  function drawTape() {
    plan.names.forEach((inPlacement, placement) => tapeOf(inPlacement).forEach(({ start, end, metres }, n) => {
      for (const part of all(`[data-tape="${placement}-${n}"]`)) {
        const [from, to, length] = part.querySelectorAll("b");
        const text = `${metres.toFixed(2)} m`;
        const tick = part.parentElement.querySelector("input");
        if (tick && (length.textContent !== text || from.textContent !== start)) tick.checked = false;
        from.textContent = start; to.textContent = end; length.textContent = text;
      }
    }));
  }

  const isMoved = () => now.some((k, p) => k !== own[p]);
  const errorsNow = () => models.map((model) => errorsOf(model, sumOf(model, now)));

  /** The plan with the poles where they are now, as `calibrate --plan` reads it. */
  function movedPlan() {
    const changed = structuredClone(plan.document), errors = errorsNow();
    const moved = names.filter((_, p) => now[p] !== own[p]);
    changed.placements.forEach((placement) => {
      for (const pole of placement.poles.filter(({ name }) => moved.includes(name))) {
        const k = now[names.indexOf(pole.name)], length = Math.hypot(...plan.axis[k]);
        Object.assign(pole, {
          foot_m: plan.foot[k], direction: plan.axis[k].map((each) => each / length),
          lean_rad: plan.towards[k] ? leanOf(k) : 0, towards: plan.towards[k], words: `pole ${pole.name}: ${plan.words[k]}`,
          seen: seers(k).map((i) => {
            const [returns, rings, mm] = plan.sights[k].slice(3 * i, 3 * i + 3);
            return { lidar: plan.lidars[i], returns, rings: rings < 0 ? null : rings, distance_m: mm / 1000 };
          }),
        });
      }
      placement.tape = tapeOf(placement.poles.map(({ name }) => name));
    });
    const sigmas = models.map((_, m) => errors[m].map((each, k) => each * plan.stated[m][k] / planned[m][k]));
    const [together, alone] = sigmas.map((each) => error(Math.max(...each)));
    return Object.assign(changed, {
      // What the page cannot work out is no more in it.
      predicted: [], more: [], rehearsal: null, probability: null,
      moved: { poles: moved, errors: plan.lidars.slice(1).map((lidar, k) => ({ lidar, sigma_m: sigmas[0][k], alone_m: sigmas[1][k] })) },
      words: [`Moved by hand: ${moved.join(", ")}. The error to expect at ${plan.range} m is ${together} (1 σ), by the poles alone ${alone}, as the page computes it; nothing was rehearsed.`, ...warnings()],
    });
  }

  $("#save").addEventListener("click", () => {
    const address = URL.createObjectURL(new Blob([JSON.stringify(movedPlan(), null, 1), "\n"], { type: "application/json" }));
    Object.assign(document.createElement("a"), { href: address, download: "moved-plan.json" }).click();
    setTimeout(() => URL.revokeObjectURL(address), 60000);
  });

  let said = null;
  function draw(isSpoken) {
    const moved = isMoved();
    const errors = moved ? errorsNow().map(worst) : stated;
    ["#now-together", "#now-alone"].forEach((id, m) => {
      const part = $(id), before = part.dataset.plan;
      part.textContent = moved ? `now ${error(errors[m])}` : before;
      if (moved) part.append(Object.assign(document.createElement("small"), { textContent: ` plan ${before}` }));
      part.classList.toggle("worse", errors[m] > 1.25 * stated[m]);
    });
    const words = warnings();
    $("#warnings").replaceChildren(...words.map((text) => Object.assign(document.createElement("li"), { textContent: text })));
    $("#warnings").hidden = !words.length;
    $(".back").hidden = !moved;
    all(".of-plan").forEach((part) => { part.hidden = moved; });
    all(".changed").forEach((part) => { part.hidden = !moved; });
    all(".card .expected").forEach((part) => { part.textContent = error(errors[0]); });
    drawTape();
    clearTimeout(said);
    if (isSpoken) {
      // Only where a pole comes to rest: it passes many places.
      said = setTimeout(() => {
        $("#spoken").textContent = [`${names[chosen]}: ${plan.words[now[chosen]]}.`, `Now ${error(errors[0])}, plan ${error(stated[0])}; by the poles alone ${error(errors[1])}.`, ...words].join(" ");
      }, 400);
    }
  }

  /** Show where the chosen pole could stand as well, and how good that is. */
  function drawSpots() {
    const rest = now.filter((_, p) => p !== chosen), sums = models.map((model) => sumOf(model, rest));
    const errorAt = (k) => Math.sqrt(models.reduce((product, model, m) => {
      const total = sums[m].slice();
      add(total, model.roots[k], model.size);
      return product * worst(errorsOf(model, total), m);
    }, 1));
    const places = leansAlike(now[chosen]), least = Math.sqrt(stated[0] * stated[1]);
    spots.replaceChildren(...places.map((k) => {
      const fits = others(chosen).every((q) => !against(names[chosen], names[q], k, now[q]));
      const ratio = errorAt(k) / least;
      const kind = !fits ? "unfit" : ratio < 1.15 ? "good" : ratio < 2 ? "fair" : "poor";
      const spot = document.createElementNS(svg, "circle");
      spot.setAttribute("class", `spot ${kind}`);
      spot.setAttribute("cx", where[k][0].toFixed(1));
      spot.setAttribute("cy", where[k][1].toFixed(1));
      spot.setAttribute("r", size * { good: 5.5, fair: 4, poor: 2.5, unfit: 1.5 }[kind]);
      spot.addEventListener("click", () => { const p = chosen; move(p, k); picture.querySelector(`[data-pole="${p}"]`).focus({ preventScroll: true }); });
      return spot;
    }));
  }

  function choose(p) {
    if (chosen !== p || !spots.childElementCount) { chosen = p; drawSpots(); }
    all(".stand").forEach((part) => part.classList.toggle("chosen", part.dataset.pole === String(p)));
  }

  function move(p, k) {
    if (now[p] === k) return;
    const turned = along(plan.axis[now[p]], plan.axis[k]) < 0.9999;
    now[p] = k;
    drawPole(p);
    draw(true);
    if (turned || p !== chosen) { chosen = -1; choose(p); }
  }

  /** Where a pole that leans as it does could stand nearest to a place in the picture. */
  function nearest(p, x, y) {
    const away = (k) => Math.hypot(where[k][0] - x, where[k][1] - y);
    return leansAlike(now[p]).reduce((best, k) => (away(k) < away(best) ? k : best), now[p]);
  }

  function inPicture(event) {
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(picture.getScreenCTM().inverse());
    return [at.x, at.y];
  }

  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  /** The next place in the direction of an arrow key, within 60° of it; null where there is none. */
  function next(p, [wx, wy]) {
    let best = null, least = Infinity;
    for (const k of leansAlike(now[p])) {
      const [x, y] = [0, 1].map((i) => where[k][i] - where[now[p]][i]);
      const ahead = x * wx + y * wy, aside = Math.abs(x * wy - y * wx);
      if (ahead > 0.5 && aside < 1.75 * ahead && ahead + 2 * aside < least) { best = k; least = ahead + 2 * aside; }
    }
    return best;
  }

  for (const part of picture.querySelectorAll(".stand")) {
    const p = Number(part.dataset.pole);
    let grip = null;
    part.setAttribute("tabindex", "0");
    part.setAttribute("role", "button");
    part.setAttribute("aria-roledescription", "pole that arrow keys move");
    part.addEventListener("focus", () => choose(p));
    // A finger on a pole moves it; beside one it scrolls the page. No touch-action does that: on a
    // part of a picture it is ignored, and on all of the picture nothing would scroll there.
    part.addEventListener("touchstart", (event) => event.preventDefault(), { passive: false });
    part.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      event.preventDefault();
      part.focus({ preventScroll: true });
      choose(p);
      const [x, y] = inPicture(event);
      grip = [x - where[now[p]][0], y - where[now[p]][1]];
      part.setPointerCapture(event.pointerId);
    });
    part.addEventListener("pointermove", (event) => {
      if (!grip) return;
      const [x, y] = inPicture(event);
      move(p, nearest(p, x - grip[0], y - grip[1]));
    });
    for (const end of ["pointerup", "pointercancel"]) part.addEventListener(end, () => { grip = null; });
    part.addEventListener("keydown", (event) => {
      const k = event.key in ways ? next(p, ways[event.key]) : event.key === "Home" ? own[p] : undefined;
      if (k === undefined) return;
      event.preventDefault();
      if (k === null) return;
      move(p, k);
      look();
    });
  }

  all("[data-lean]").forEach((part) => part.addEventListener("change", () => move(Number(part.dataset.lean), Number(part.value))));
  $("#back").addEventListener("click", () => {
    own.forEach((k, p) => { now[p] = k; drawPole(p); });
    chosen = Math.max(chosen, 0);
    draw(true);
    drawSpots();
    picture.querySelector(`[data-pole="${chosen}"]`).focus({ preventScroll: true });
  });
  all("[data-show]").forEach((button) => button.addEventListener("click", () => {
    all("[data-show]").forEach((other) => other.setAttribute("aria-pressed", String(other === button)));
    const shown = button.dataset.show;
    picture.querySelectorAll(".stand").forEach((part) => part.classList.toggle("faded", shown !== "" && part.dataset.place !== shown));
    all(".row").forEach((part, p) => { part.hidden = shown !== "" && String(placementOf[p]) !== shown; });
  }));

  // Twice as large, about all LiDARs and poles, or the chosen pole where these are too far apart; the
  // scale bar goes along into the corner.
  function look() {
    const isClose = size < 1, whole = [plan.width, plan.height];
    const there = [...now.map((k) => where[k]), ...plan.at.map(inPlace)];
    const corner = [0, 1].map((i) => {
      const [low, high] = [Math.min, Math.max].map((most) => most(...there.map((each) => each[i])));
      const middle = high - low < whole[i] / 2 - 40 ? (low + high) / 2 : where[now[Math.max(chosen, 0)]][i];
      return isClose ? Math.min(Math.max(middle - whole[i] / 4, 0), whole[i] / 2) : 0;
    });
    picture.setAttribute("viewBox", [...corner, ...whole.map((each) => (isClose ? each / 2 : each))].join(" "));
    const bar = picture.querySelector(".scale-bar");
    bar.setAttribute("transform", `translate(${corner.join(" ")}) scale(${isClose ? 0.5 : 1})`);
    bar.querySelector("text").textContent = `${Number(bar.dataset.metres) / (isClose ? 2 : 1)} m`;
  }
  $("#closer").addEventListener("click", () => {
    size = size < 1 ? 1 : 0.6;
    $("#closer").setAttribute("aria-pressed", String(size < 1));
    picture.classList.toggle("close", size < 1);
    look();
    now.forEach((_, p) => drawPole(p));
    if (spots.childElementCount) drawSpots();
  });

  picture.setAttribute("role", "group");
  all(".hint-of-poles, .row label, .choices").forEach((part) => { part.hidden = false; });
  now.forEach((_, p) => drawPole(p));
  draw(false);
  root.dataset.predicted = JSON.stringify(planned);
  root.dataset.usable = String(Math.round(performance.now()));
})();
