"use strict";
// The page of a pair, of a site, of recordings, or of a field test, which has no view.
(() => {
  const started = performance.now();

  // --- copying, frame names, theme and paper: they work even where the view does not ---

  const exportTexts = new Map(all("[data-export]").map((pre) => [pre, pre.textContent]));
  function nameFrames() {
    const names = new Map(all("[data-frame]").map((field) => [
      // A robot's base is no LiDAR: what is written for it would be the pose of another thing.
      field.dataset.frame, field.validity.valid && field.value.replace(/[^\w./-]/g, "_") || field.dataset.frame,
    ]));
    const pattern = new RegExp([...names.keys()].join("|"), "g");
    for (const [pre, text] of exportTexts) pre.textContent = text.replace(pattern, (name) => names.get(name));
  }
  all("[data-frame]").forEach((field) => field.addEventListener("input", nameFrames));
  nameFrames();

  setUpPage(() => repaint());

  // What is folded is on paper all the same: the poses are what it is printed for.
  let onPaper = false;
  setUpPaper("details.lidar", () => { onPaper = true; if (scene) printView(); }, () => {
    onPaper = false;
    if (scene) { resize(marks.clientWidth, marks.clientHeight, ratio()); repaint(); }
  });

  root.dataset.started = String(Math.round(started));
  const scene = JSON.parse($("#data").textContent);
  let repaint = () => {};
  if (!scene) { root.dataset.usable = String(Math.round(performance.now())); return; }

  // --- what is shown ---

  const pair = scene.kind === "pair", recordings = scene.kind === "recordings", alone = recordings || scene.kind === "alone";
  const first = scene.clouds[0];
  const poses = new Map(scene.poses.map((pose) => [pose.id, pose]));
  const layers = { poles: true, names: true, rejected: pair || recordings, contradicting: true, ellipsoid: true, intensity: true };
  /** Without poses one LiDAR at a time is shown, in its frame. */
  const lidars = scene.lidars.map((_, k) => !alone || k === first.lidar);
  const places = scene.placements.map((_, j) => j === first.placement);
  const state = { mode: pair ? "apart" : "after", pose: scene.poses.length ? scene.poses[0].id : null, T: IDENTITY, size: 1.5 };

  const isOn = (cloud) => lidars[cloud.lidar] && places[cloud.placement];
  /** Clouds that were shown until now: a recording is decoded when it is shown for the first time. */
  let loaded = [];
  function hold() {
    const before = loaded.length;
    for (const cloud of scene.clouds) {
      if (!places[cloud.placement] || (alone && !isOn(cloud))) continue;
      cloud.decoded ||= decodeCloud(cloud.points);
      cloud.threshold ??= cloud.decoded.levels?.threshold;
      cloud.denying ||= Object.fromEntries(Object.entries(cloud.contradicting).map(([pose, points]) => [pose, decodePoints(points)]));
    }
    loaded = scene.clouds.filter((cloud) => cloud.decoded);
    return loaded.length !== before;
  }
  /** Where the camera looks in each of two panes: at the poles of each LiDAR, or at the whole site. */
  function frames() {
    const [x, y, z] = scene.centre;
    if (scene.kind === "site") return [{ centre: scene.centre, origin: [x + scene.radius, y, z], radius: scene.radius }];
    if (alone) return [(loaded.find(isOn) || loaded[0]).decoded];
    return [0, 1].map((k) => loaded.find((cloud) => cloud.lidar === k).decoded);
  }

  hold();
  const [canvas, marks] = [$("#points"), $("#marks")];
  const webgl = canvas.getContext("webgl2", { antialias: false, alpha: false });
  const decoded = () => loaded.map((cloud) => cloud.decoded);
  const view = webgl ? webglView(canvas, webgl, marks, decoded(), frames()) : topView(canvas, marks, decoded(), frames());
  if (!webgl) {
    $("#fallback").textContent = "This browser gives no WebGL: the clouds are shown from above.";
    $("#fallback").hidden = false;
  }
  root.dataset.view = view.kind;

  let width = 0, height = 0;
  let ratio = () => Math.min(devicePixelRatio || 1, 2);

  const colourOf = (lidar) => colour(`--lidar-${scene.lidars[lidar].colour}`);
  /** Pose of a LiDAR, with a pair's source where a hypothesis has it. */
  const poseOf = (lidar, T) => (pair ? [IDENTITY, T][lidar] : scene.lidars[lidar].T || IDENTITY);

  /** From where on a point is bright, of 1: between two steps of the intensities that are embedded; of all other pages nothing is. */
  function limitOf({ threshold, decoded: { levels } }) {
    return levels ? (Math.ceil((65535 * (threshold - levels.low)) / (levels.high - levels.low) - 1e-6) - 0.5) / 65535 : 2;
  }
  function styleOf(plain) {
    const css = (name) => `rgb(${colour(name)})`;
    return {
      ground: colour("--view"), bright: colour("--bright"), limits: loaded.map(limitOf), colours: loaded.map((cloud) => colourOf(cloud.lidar)), ofLidar: scene.lidars.map((_, k) => colourOf(k)),
      text: css("--text"), soft: css("--soft"), faint: css("--line"), contradicting: css("--denied"),
      visible: loaded.map((cloud) => (plain ? places[cloud.placement] : isOn(cloud))), shade: layers.intensity ? 1 : 0,
      size: plain ? 0.8 : state.size, dpr: ratio(), lidars: lidars.map((on) => plain || on), places, layers, plain,
    };
  }

  /** A pane whose source is placed by a pose, or which shows the clouds of some LiDARs alone. */
  function pane(box, T, id, more) {
    const sensors = scene.lidars.map((_, k) => poseOf(k, T));
    return { ...box, frame: 0, id, sensors, poses: loaded.map((cloud) => sensors[cloud.lidar]), ...more };
  }
  function panes() {
    if (state.mode !== "apart") {
      const after = pair && state.mode === "after";
      return [pane({ x: 0, y: 0, w: width, h: height }, state.T, after ? state.pose : null, { ellipsoid: after && state.pose === "result" })];
    }
    const wide = width > height * 1.2;
    const [w, h] = wide ? [Math.floor(width / 2), height] : [width, Math.floor(height / 2)];
    const only = (k) => ({
      frame: k, title: `${scene.lidars[k].name}, in its frame`,
      sensors: [0, 1].map((n) => (n === k ? IDENTITY : null)), poses: loaded.map((cloud) => (cloud.lidar === k ? IDENTITY : null)),
    });
    return [
      pane({ x: 0, y: 0, w, h }, IDENTITY, null, only(0)),
      pane({ x: wide ? w : 0, y: wide ? 0 : h, w: wide ? width - w : w, h: wide ? h : height - h }, IDENTITY, null, only(1)),
    ];
  }

  function paint() {
    if (!width) return;
    const style = styleOf(false), parts = panes(), context = marks.getContext("2d");
    view.paint(parts, style, height);
    context.setTransform(style.dpr, 0, 0, style.dpr, 0, 0);
    context.clearRect(0, 0, width, height);
    for (const part of parts) drawMarks(context, part, view.lens(part), scene, loaded, style);
    if (picked && isOn(picked.cloud)) {
      const lens = view.lens(parts[0]), v = lens.toView(picked.at);
      context.beginPath();
      if (v[2] < -NEAR) context.arc(...lens.toPixel(v), 9, 0, 2 * Math.PI);
      context.lineWidth = 2;
      context.strokeStyle = style.contradicting;
      context.stroke();
    }
    if (parts.length === 2) {
      const p = parts[1];
      context.fillStyle = style.faint;
      if (p.x) context.fillRect(p.x, 0, 1, height); else context.fillRect(0, p.y, width, 1);
    }
  }

  /** Draw every hypothesis in its panel, from where the main view looks. */
  function paintPanels() {
    for (const panel of all(".panel")) {
      const target = panel.querySelector("canvas"), box = onPaper ? PAPER.panel : target.getBoundingClientRect();
      const w = Math.min(Math.floor(box.width), width), h = Math.min(Math.floor(box.height), height);
      if (!w || !h) continue;
      const style = styleOf(true), dpr = style.dpr;
      const part = pane({ x: 0, y: 0, w, h }, poses.get(panel.dataset.pose).T, panel.dataset.pose);
      view.paint([part], style, height);
      target.width = w * dpr;
      target.height = h * dpr;
      const context = target.getContext("2d");
      context.drawImage(canvas, 0, 0, w * dpr, h * dpr, 0, 0, w * dpr, h * dpr);
      context.setTransform(dpr, 0, 0, dpr, 0, 0);
      drawMarks(context, part, view.lens(part), scene, loaded, style);
    }
    paint();
  }

  let requested = false, later = 0;
  repaint = (withPanels = true) => {
    if (!requested) { requested = true; requestAnimationFrame(() => { requested = false; paint(); }); }
    if (withPanels && poses.size) { clearTimeout(later); later = setTimeout(paintPanels, 150); }
  };

  // --- poses of a pair: the source cloud moves smoothly from one to the next ---

  const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");
  let motion = 0;
  function goal() { return state.mode === "after" && state.pose ? poses.get(state.pose).T : IDENTITY; }
  function moveTo(T) {
    const from = state.T, run = ++motion;
    if (reducedMotion.matches || view.kind !== "webgl" || state.mode === "apart") { state.T = T; repaint(false); return; }
    const split = (M) => {
      const matrix = new THREE.Matrix4().set(...M.flat());
      return { q: new THREE.Quaternion().setFromRotationMatrix(matrix), t: new THREE.Vector3().setFromMatrixPosition(matrix) };
    };
    const [a, b] = [split(from), split(T)], begin = performance.now();
    const step = () => {
      if (run !== motion) return;
      const s = Math.min(1, (performance.now() - begin) / 450), eased = s * s * (3 - 2 * s);
      if (s < 1) {
        const m = new THREE.Matrix4().makeRotationFromQuaternion(a.q.clone().slerp(b.q, eased));
        m.setPosition(a.t.clone().lerp(b.t, eased));
        const e = m.elements;
        state.T = [0, 1, 2, 3].map((r) => [e[r], e[r + 4], e[r + 8], e[r + 12]]);
        requestAnimationFrame(step);
      } else state.T = T;
      paint();
    };
    step();
  }

  // --- what the reader chooses ---

  function describePair() {
    if (state.mode === "apart") return "Apart: each cloud in its frame.";
    if (state.mode === "before") return "Before: both clouds as recorded, as if they had one frame.";
    const shown = state.pose === "result" && scene.ellipsoid && layers.ellipsoid
      ? ` Ellipsoid: 1 σ of the source's position, enlarged ${scene.ellipsoid.factor.toLocaleString("en")} times.` : "";
    const caution = scene.status === "refused" ? " This run was refused: no hypothesis is its result." : "";
    const conflicts = loaded.some((cloud) => places[cloud.placement] && cloud.denying[state.pose].length);
    const red = layers.contradicting && conflicts ? " Red: in space that the other LiDAR saw to be empty." : "";
    return `After: source transformed by ${state.pose === "result" ? "the result" : poses.get(state.pose).label}.${caution}${red}${shown}`;
  }
  function describeRecording({ lidar, threshold, decoded: { levels }, poles, rejected }) {
    const name = `${scene.lidars[lidar].name}, in its frame.`;
    if (!levels) return `${name} Its intensities do not show tape.`;
    const found = poles.length || rejected.length ? ` Poles and rejected clusters: as found from ${short(levels.threshold)} up.` : "";
    return `${name} In colour: ${short(threshold)} or brighter.${found}`;
  }
  function describe() {
    const names = scene.lidars.filter((_, k) => lidars[k]).map((lidar) => lidar.name);
    const chosen = scene.placements.filter((_, j) => places[j]);
    const what = names.length === lidars.length ? `all ${names.length} LiDARs` : names.join(", ") || "no LiDAR";
    const when = chosen.length ? `placement ${chosen.join(", ")}` : "no placement";
    if (pair) return describePair() + (places.length > 1 ? ` Shown: ${when}.` : "");
    if (!alone) return `Shown: ${what}; ${when}.`;
    if (recordings) return describeRecording(loaded.find(isOn));
    const none = scene.clouds.some(isOn) ? "" : " It recorded nothing there.";
    return `Refused, so there are no poses: ${what} alone, in its frame; ${when}.${none}`;
  }
  let shownAlone = "";
  const short = (value) => String(Number(value.toPrecision(4)));
  const slider = $("#threshold");
  function tellThreshold() {
    const { decoded: { levels }, threshold } = loaded.find(isOn), limit = 65535 * limitOf(loaded.find(isOn));
    const bright = levels.values.reduce((sum, value) => sum + (value >= limit), 0);
    $("#level").textContent = `${short(threshold)}: ${bright.toLocaleString("en")} points`;
    slider.setAttribute("aria-valuetext", $("#level").textContent);
  }
  /** Set the slider to the threshold of the recording that is shown. */
  function offerThreshold() {
    if (!slider) return;
    const { decoded: { levels }, threshold } = loaded.find(isOn);
    slider.parentElement.hidden = !levels;
    if (!levels) return;
    const low = Math.min(levels.median, levels.threshold), high = Math.max(levels.high, levels.threshold);
    const step = 10 ** Math.floor(Math.log10((high - low) / 200));
    Object.assign(slider, { step, min: Math.floor(low / step) * step, max: Math.ceil(high / step) * step, value: threshold, hidden: false });
    tellThreshold();
  }
  slider?.addEventListener("input", () => {
    loaded.find(isOn).threshold = Number(slider.value);
    tellThreshold();
    repaint(false);
  });
  slider?.addEventListener("change", () => { $("#state").textContent = describe(); });

  // --- a point of a recording is picked: where the LiDAR sees a surveyed target ---

  /** Returns of a target lie within this distance, metres, of the picked one. */
  const TARGET = 0.15;
  let picked = null;
  function pick(at) {
    const cloud = loaded.find(isOn), [part] = panes();
    const n = pickPoint(cloud.decoded, view.lens(part), at, 8);
    if (n === null) return;
    const point = pointOf(cloud.decoded, n), strength = cloud.decoded.levels?.values, limit = 65535 * limitOf(cloud);
    const bright = [];
    for (let k = 0; strength && strength[n] >= limit && k < cloud.decoded.count; k++) {
      if (strength[k] < limit) continue;
      const p = pointOf(cloud.decoded, k);
      if (Math.hypot(...p.map((v, axis) => v - point[axis])) <= TARGET) bright.push(p);
    }
    const mean = bright.length ? point.map((_, axis) => bright.reduce((sum, p) => sum + p[axis], 0) / bright.length) : point;
    picked = { cloud, at: mean };
    const place = mean.map((v) => v.toFixed(3)).join(", "), name = scene.lidars[cloud.lidar].name;
    $("#picked-at").textContent = bright.length
      ? `Picked: the middle of ${bright.length} bright returns within ${100 * TARGET} cm, in the frame of ${name}, m`
      : `Picked: one return, in the frame of ${name}, m`;
    $("#picked pre").textContent = `[[control_point.seen]]\nlidar = ${JSON.stringify(name)}\nat_m = [${place}]\nsigma_m = 0.01`;
    $("#picked").hidden = false;
    repaint(false);
  }
  if ($("#picked")) {
    let from = null;
    marks.addEventListener("pointerdown", (e) => { from = [e.clientX, e.clientY]; });
    marks.addEventListener("click", (e) => {
      // A drag turns the view.
      if (!from || Math.hypot(e.clientX - from[0], e.clientY - from[1]) > 4) return;
      const box = marks.getBoundingClientRect();
      pick([e.clientX - box.left, e.clientY - box.top]);
    });
  }

  function press(name, isPressed) {
    all(`button[data-${name}]`).forEach((b) => b.setAttribute("aria-pressed", String(isPressed(b.dataset[name]))));
  }
  function refresh() {
    Object.assign(root.dataset, {
      mode: state.mode, pose: state.pose || "", lidars: lidars.map(Number).join(""), places: places.map(Number).join(""),
    });
    press("mode", (mode) => mode === state.mode);
    press("layer", (layer) => layers[layer]);
    press("pose", (pose) => state.mode === "after" && pose === state.pose);
    press("lidar", (k) => lidars[k]);
    press("place", (j) => places[j]);
    if (pair) $("#pose").value = state.pose || "";
    const turned = alone && lidars.join() + places.join() !== shownAlone;
    if (hold() || turned) view.load(decoded(), frames());
    if (turned) { shownAlone = lidars.join() + places.join(); view.preset("oblique"); offerThreshold(); }
    $("#state").textContent = describe();
  }
  function setMode(mode) {
    if (!pair || (mode === "after" && !state.pose)) return;
    state.mode = mode;
    refresh();
    moveTo(goal());
  }
  function setPose(id) {
    if (!poses.has(id)) return;
    state.pose = id;
    setMode("after");
  }
  function toggleLayer(layer) {
    layers[layer] = !layers[layer];
    refresh();
    repaint(layer === "intensity" || layer === "contradicting");
  }
  function toggle(list, k) {
    if (alone) list.forEach((_, n) => { list[n] = n === k; }); else list[k] = !list[k];
    refresh();
    repaint(list === places);
  }

  const on = (name, act) => all(`button[data-${name}]`).forEach((b) => b.addEventListener("click", () => act(b.dataset[name])));
  on("mode", setMode);
  on("layer", toggleLayer);
  on("lidar", (k) => toggle(lidars, Number(k)));
  on("place", (j) => toggle(places, Number(j)));
  on("preset", (name) => { view.preset(name); repaint(); });
  // Panels that are folded away have no size to be drawn in.
  all("details:has(.panel)").forEach((fold) => fold.addEventListener("toggle", () => repaint()));
  on("pose", (pose) => {
    setPose(pose);
    const box = $(".stage").getBoundingClientRect();
    if (box.bottom < 200 || box.top > innerHeight - 200) $(".viewer").scrollIntoView();
  });
  if (pair) {
    for (const pose of scene.poses) $("#pose").append(new Option(pose.label, pose.id));
    $("#pose").addEventListener("change", (e) => setPose(e.target.value));
    $(".pose").hidden = !poses.size;
    $('[data-mode="after"]').disabled = !poses.size;
  }
  const there = {
    poles: scene.poles.length || scene.clouds.some((cloud) => cloud.poles.length),
    rejected: scene.clouds.some((cloud) => cloud.rejected.length),
    contradicting: scene.clouds.some((cloud) => Object.values(cloud.contradicting).some((points) => points.xyz)),
    ellipsoid: scene.ellipsoid,
    intensity: scene.clouds.some((cloud) => cloud.points.shown),
  };
  for (const [layer, any] of Object.entries(there)) $(`[data-layer="${layer}"]`).hidden = !any;
  for (const name of ["top", "side"]) $(`[data-preset="${name}"]`).hidden = view.kind === "top";
  $("#size").addEventListener("input", (e) => { state.size = Number(e.target.value); repaint(false); });

  handOver(view, () => repaint());
  document.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || e.target.closest("input, select, textarea, pre")) return;
    // With Shift, a key gives the sign above its digit: its place on the keyboard says which it is.
    const digit = /^(?:Digit|Numpad)([1-9])$/.exec(e.code);
    const key = digit ? (e.shiftKey ? "Shift+" : "") + digit[1] : e.key;
    if (key === "b") setMode(state.mode === "before" ? "after" : "before");
    else if (key === "0") setPose("result");
    else if (key === "a" && !alone) { lidars.fill(true); refresh(); repaint(); }
    else all("[aria-keyshortcuts]").find((b) => b.getAttribute("aria-keyshortcuts") === key && !b.hidden)?.click();
  });

  view.onMove(() => repaint(false));
  view.onSettle(() => repaint());
  new ResizeObserver(() => {
    if (onPaper) return;
    resize(marks.clientWidth, marks.clientHeight, ratio());
    paint();
    repaint();
    if (!root.dataset.usable) root.dataset.usable = String(Math.round(performance.now()));
  }).observe(marks);

  // --- paper: light colours, and pictures whose shape is not the window's ---

  function resize(w, h, dpr) {
    [width, height] = [w, h];
    view.resize(w, h, dpr);
    marks.width = w * dpr;
    marks.height = h * dpr;
  }
  function printView() {
    const picture = $("#printed"), screenRatio = ratio;
    ratio = () => PAPER.dpr;
    resize(PAPER.width, PAPER.height, PAPER.dpr);
    paintPanels();
    [picture.width, picture.height] = [canvas.width, canvas.height];
    for (const layer of [canvas, marks]) picture.getContext("2d").drawImage(layer, 0, 0);
    picture.hidden = false;
    ratio = screenRatio;
  }

  state.mode = pair && !poses.has("result") ? "apart" : "after";
  state.T = goal();
  refresh();
})();
