"use strict";
// The page of a watch: the one next thing to do, in large, and below what is seen now.
(() => {
  const EVERY_MS = 400, GIVEN_UP_MS = 2500, LOST_MS = 3000, STUCK_MS = 5000, MOST_WORDS = 50;
  const $ = (id) => document.getElementById(id);
  /** All text of the document gets in here, as text. */
  function make(tag, kind, ...inside) {
    const made = document.createElement(tag);
    if (kind) made.className = kind;
    made.append(...inside);
    return made;
  }
  function sign(name) {
    const [picture, use] = ["svg", "use"].map((tag) => document.createElementNS("http://www.w3.org/2000/svg", tag));
    use.setAttribute("href", `#sign-${name}`);
    picture.setAttribute("aria-hidden", "true");
    picture.append(use);
    return picture;
  }

  // --- numbers ---

  const counted = (count, name) => `${count.toLocaleString("en").replaceAll(",", " ")} ${name}${count === 1 ? "" : "s"}`;
  /** Two significant digits, and no exponent. */
  const short = (value) => value >= 100 ? String(Math.round(value)) : String(Number(value.toPrecision(2)));
  const length = (metres) => metres < 0.0995 ? `${short(1000 * metres)} mm` : `${short(metres)} m`;
  const plain = (value) => String(Number(value.toPrecision(6)));
  /** A bound is rounded up: 2.01 cm are not within 2 cm. */
  function atMost(value) {
    if (!(value > 0)) return "0";
    const digit = 10 ** (Math.floor(Math.log10(value)) - 1);
    return plain(Math.ceil(value / digit - 1e-9) * digit);
  }
  const percent = (share) => `${Math.max(0, Math.min(Math.floor(100 * share + 1e-9), 99))} %`;
  const degrees = (angle) => `${Math.round(angle * 180 / Math.PI)}°`;

  // --- the large field ---

  const VERDICTS = {
    ok: ["good", "good", "Done"], warn: ["doubt", "doubt", "Done, with a warning"], refused: ["todo", "lost", "No answer"],
    same: ["good", "good", "Same"], moved: ["todo", "todo", "Moved"], cannot_tell: ["doubt", "doubt", "Cannot tell"],
  };
  /** Tone, sign and word. */
  function toneOf(doc) {
    if (doc.phase === "done") return VERDICTS[Object.hasOwn(VERDICTS, doc.status) ? doc.status : "refused"];
    if (!doc.is_good) return ["todo", "todo", "To do"];
    const words = { capturing: "Good, keep still", walking: "Go on" };
    return ["good", "good", words[doc.phase] || "Good"];
  }
  function put(node, text) {
    // A screen reader says again what is set again.
    if (node.textContent !== text) node.textContent = text;
  }
  function say([tone, mark, word], next) {
    $("field").dataset.tone = tone;
    $("sign").setAttribute("href", `#sign-${mark}`);
    $("next").dataset.length = next.length > 110 ? "longest" : next.length > 42 ? "long" : next.length > 22 ? "" : "short";
    put($("word"), word);
    put($("next"), next);
  }

  // --- what is below ---

  /** Lay out a part where what it shows has changed. */
  const shown = new Map();
  function lay(id, what, parts) {
    const text = JSON.stringify(what);
    if (shown.get(id) === text) return;
    shown.set(id, text);
    $(id).replaceChildren(...parts());
  }
  /** A line of numbers that breaks between them alone. */
  function numbers(...each) {
    const parts = each.filter(Boolean).map((text, k, all) => make("span", "", k < all.length - 1 ? `${text} ·` : text));
    return make("p", "numbers", ...parts.flatMap((part) => [part, " "]));
  }

  function poleOf(pole) {
    const head = make("p", "", make("b", "", `Pole ${pole.name}`), " ", make("span", pole.is_good ? "" : "fault", pole.word || (pole.is_good ? "good" : "not good")));
    const rings = pole.rings === null ? "" : counted(pole.rings, "ring");
    const seen = numbers(`${pole.distance_m.toFixed(2)} m`, counted(pole.returns, "return"), rings, pole.is_still ? "still" : "moving");
    return make("li", pole.is_good ? "good" : "", sign(pole.is_good ? "good" : "todo"), head, seen);
  }
  function lidarOf(lidar) {
    const age = lidar.age_s === null ? "no sweep yet" : `${lidar.age_s.toFixed(1)} s old`;
    const parts = [
      make("h2", "", lidar.name), make("p", "soft", lidar.source),
      numbers(`${lidar.sweeps_per_s.toFixed(1)} sweeps a second`, age, counted(lidar.points, "point")),
    ];
    if (lidar.word) parts.push(make("p", "fault", lidar.word));
    if (lidar.skipped) parts.push(make("p", "soft", lidar.skipped));
    if (lidar.poles.length) parts.push(make("ul", "poles", ...lidar.poles.map(poleOf)));
    else parts.push(make("p", "soft", "No pole is seen."));
    return make("section", "", ...parts);
  }

  /** Names and values of what is known now. */
  function factsOf(doc) {
    const facts = [];
    if (doc.angle_rad !== null) facts.push(["Angle between the poles", degrees(doc.angle_rad)]);
    if (doc.placements) facts.push(["Placements kept", String(doc.placements)]);
    if (doc.need) {
      const now = doc.bound_m === null ? "" : `, now ${atMost(100 * doc.bound_m)} cm`;
      const sure = doc.probability === null ? "" : `, ${percent(doc.probability)} sure`;
      facts.push(["Needed", `within ${plain(100 * doc.need.within_m)} cm at ${plain(doc.need.at_m)} m${now}${sure}`]);
    }
    if (doc.predicted_error.length) {
      const each = doc.predicted_error.map((e) => `${length(e.sigma_m)} at ${plain(e.range_m)} m`);
      facts.push(["Predicted error now, 1 σ", each.join(", ")]);
    }
    return facts;
  }

  // --- a walk ---

  const WIDE = 480, EDGE = 36;
  function drawn(tag, kind, attributes, text) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    if (kind) made.setAttribute("class", kind);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, String(value));
    if (text) made.textContent = text;
    return made;
  }
  function picture(high, label, ...parts) {
    const made = drawn("svg", "", { viewBox: `0 0 ${WIDE} ${high}`, role: "img", "aria-label": label });
    made.append(...parts);
    return made;
  }
  const lineOf = (points) => points.map((point) => point.map((v) => v.toFixed(1)).join(",")).join(" ");
  /** The way of the pole and the LiDARs, x to the right and y up. */
  function aboveOf(chart) {
    const all = [...chart.lidars, ...chart.paths.flat()];
    const [low, high] = [Math.min, Math.max].map((most) => [0, 1].map((k) => all.reduce((v, p) => most(v, p[k]), all[0][k])));
    const span = [0, 1].map((k) => Math.max(high[k] - low[k], 1));
    const scale = Math.min((WIDE - 2 * EDGE) / span[0], 420 / span[1]), tall = span[1] * scale + 2 * EDGE + 20;
    const at = ([x, y]) => [EDGE + (x - low[0]) * scale, EDGE + (high[1] - y) * scale];
    const parts = chart.names.flatMap((name, k) => {
      const path = chart.paths[k].map(at), [x, y] = at(chart.lidars[k]), last = path[path.length - 1];
      const marks = [drawn("polyline", `lidar-${k}`, { points: lineOf(path) }), drawn("rect", `lidar-${k}`, { x: x - 7, y: y - 7, width: 14, height: 14 })];
      if (last) marks.push(drawn("circle", `lidar-${k} here`, { cx: last[0], cy: last[1], r: 8 }));
      const left = x > WIDE / 2;
      marks.push(drawn("text", "", { x: left ? x - 14 : x + 14, y: y + 5, "text-anchor": left ? "end" : "start" }, name));
      return marks;
    });
    const metre = [1, 2, 5, 10, 20, 50].find((m) => m * scale > 60) || 100;
    parts.push(drawn("line", "axis", { x1: EDGE, x2: EDGE + metre * scale, y1: tall - 14, y2: tall - 14 }), drawn("text", "", { x: EDGE, y: tall - 20 }, `${metre} m`));
    return picture(tall, `Where ${chart.names.join(" and ")} saw the pole; the circle is where it was seen last`, ...parts);
  }
  /** What no point is off by more than, against how long the walk was, with the need. */
  function fallOf(walk, need) {
    const most = Math.min(Math.max(...walk.bounds.map((b) => b[1]), need), 10 * need), last = Math.max(walk.bounds[walk.bounds.length - 1][0], 10);
    const at = ([seconds, bound]) => [EDGE + seconds / last * (WIDE - 2 * EDGE), 30 + 130 * (1 - Math.min(bound / most, 1))];
    const line = (kind, from, to) => drawn("polyline", kind, { points: lineOf([from, to].map(at)) });
    return picture(190, `Largest error up to ${plain(walk.at_m)} m away as the walk goes on`,
      line("axis", [0, 0], [last, 0]), line("need", [0, need], [last, need]),
      drawn("polyline", "lidar-0", { points: lineOf(walk.bounds.map(at)) }),
      drawn("text", "", { x: EDGE, y: 20 }, `no point is off by more than ${length(walk.bounds[walk.bounds.length - 1][1])}, 95 % sure; dashed: needed`),
      drawn("text", "", { x: EDGE, y: 180 }, "0 s"), drawn("text", "", { x: WIDE - EDGE, y: 180, "text-anchor": "end" }, `${Math.round(last)} s`));
  }
  function showWalk(doc) {
    $("walk").hidden = !doc.walk;
    if (!doc.walk) return;
    lay("charts", doc.walk, () => {
      const parts = doc.walk.charts.map(aboveOf);
      if (doc.walk.bounds.length) parts.push(fallOf(doc.walk, doc.need.within_m));
      parts.push(make("p", "numbers", `Both saw the pole for ${Math.round(doc.walk.seconds)} s.`));
      return parts;
    });
  }

  function showRest(doc) {
    showWalk(doc);
    const isCapturing = doc.phase === "capturing" && doc.wanted > 0;
    $("progress").hidden = !isCapturing;
    if (isCapturing) {
      put($("count"), `${doc.captured} of ${counted(doc.wanted, "sweep")}`);
      $("bar").max = doc.wanted;
      $("bar").value = Math.min(doc.captured, doc.wanted);
    }
    lay("lidars", doc.lidars, () => doc.lidars.map(lidarOf));
    const facts = factsOf(doc), words = doc.words.slice(-MOST_WORDS).reverse();
    $("answer").hidden = !facts.length;
    lay("facts", facts, () => facts.map(([name, value]) => make("div", "", make("dt", "", name), make("dd", "", value))));
    $("past").hidden = !words.length;
    lay("words", words, () => words.map((text) => make("li", "", text)));
  }

  // --- sound, and a screen that stays on ---

  let sounds = null;
  const SOUNDS = { good: [880], kept: [880, 880], done: [660, 880, 1320], bad: [247] };
  function play(name) {
    if (!sounds) return;
    sounds.resume();
    SOUNDS[name].forEach((pitch, k) => {
      const from = sounds.currentTime + 0.02 + 0.22 * k, lasts = name === "bad" ? 0.45 : 0.15;
      const tone = sounds.createOscillator(), loudness = sounds.createGain();
      tone.frequency.value = pitch;
      loudness.gain.setValueAtTime(0, from);
      loudness.gain.linearRampToValueAtTime(0.5, from + 0.02);
      loudness.gain.setValueAtTime(0.5, from + lasts - 0.03);
      loudness.gain.linearRampToValueAtTime(0, from + lasts);
      tone.connect(loudness).connect(sounds.destination);
      tone.start(from);
      tone.stop(from + lasts);
    });
    navigator.vibrate?.(name === "bad" ? [500] : SOUNDS[name].flatMap(() => [120, 100]));
  }
  function soundOf(before, now) {
    if (now.phase === "done" && before.phase !== "done") return toneOf(now)[0] === "todo" ? "bad" : "done";
    if (now.placements > before.placements) return "kept";
    if (now.is_good !== before.is_good) return now.is_good ? "good" : "bad";
    return "";
  }
  $("sound").addEventListener("click", () => {
    if (sounds) sounds.close();
    sounds = sounds ? null : new AudioContext();
    $("sound").setAttribute("aria-pressed", String(sounds !== null));
    put($("sound"), sounds ? "Turn sound off" : "Turn sound on");
    play("good");
    stayOn();
  });

  function stayOn() {
    if (document.visibilityState === "visible") navigator.wakeLock?.request("screen").catch(() => {});
  }

  // --- what comes in ---

  let last = null, isLost = false, answered = performance.now(), advanced = answered;

  function show(doc) {
    const before = last;
    answered = performance.now();
    if (doc.seconds !== before?.seconds) advanced = answered;
    last = doc;
    const sound = before && soundOf(before, doc);
    if (sound) play(sound);
    showRest(doc);
    look();
  }
  function look() {
    const now = performance.now(), wasLost = isLost;
    isLost = now - answered > LOST_MS || now - advanced > STUCK_MS;
    // Once all is done the program may end: its last state stays.
    const isOver = last?.phase === "done";
    put($("stale"), !isLost || !last ? "" : isOver ? "The program has ended. This is what it said last." : "Below is what was seen last.");
    if (!isLost || isOver) {
      if (last) say(toneOf(last), last.next);
      return;
    }
    $("progress").hidden = true;
    say(["lost", "lost", "No connection"], "Connection lost, trying again");
    if (!wasLost && last?.is_good) play("bad");
  }
  async function fetched() {
    const giveUp = new AbortController(), timer = setTimeout(() => giveUp.abort(), GIVEN_UP_MS);
    try {
      const answer = await fetch("state", { cache: "no-store", credentials: "omit", redirect: "error", signal: giveUp.signal });
      return answer.ok ? await answer.json() : null;
    } catch {
      return null;
    } finally {
      clearTimeout(timer);
    }
  }
  async function poll() {
    const doc = await fetched();
    setTimeout(poll, EVERY_MS);
    if (doc) show(doc);
  }

  document.addEventListener("visibilitychange", () => {
    if (document.visibilityState !== "visible") return;
    // A browser runs no timers of a page that nobody sees.
    answered = advanced = performance.now();
    stayOn();
  });
  setInterval(look, 250);
  stayOn();
  poll();
})();
