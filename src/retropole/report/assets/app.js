"use strict";
(() => {
  const started = performance.now();

  // --- copying, frame names and theme: they work even where the view does not ---

  const exportTexts = new Map(all("[data-export]").map((pre) => [pre, pre.textContent]));
  function nameFrames() {
    const names = new Map(all("[data-frame]").map((field) => [
      field.dataset.frame, field.value.replace(/[^\w./-]/g, "_") || field.dataset.frame,
    ]));
    const pattern = new RegExp([...names.keys()].join("|"), "g");
    for (const [pre, text] of exportTexts) pre.textContent = text.replace(pattern, (name) => names.get(name));
  }
  all("[data-frame]").forEach((field) => field.addEventListener("input", nameFrames));

  setUpPage(() => repaint());

  // --- the view ---

  const scene = JSON.parse($("#data").textContent);
  /** Make a placement's clouds, poles, rejected clusters and contradicting points those of the scene. */
  function showPlacement(k) {
    const placement = scene.placements[k];
    placement.decoded ||= placement.clouds.map(decodeCloud);
    placement.denying ||= Object.fromEntries(Object.entries(placement.contradicting).map(
      ([pose, points]) => [pose, points.map(decodePoints)]));
    Object.assign(scene, { clouds: placement.decoded, poles: placement.poles, rejected: placement.rejected,
      contradicting: placement.denying });
    root.dataset.placement = String(k + 1);
    $("#shown").textContent = placement.shown;
  }
  showPlacement(0);
  const poses = new Map(scene.poses.map((pose) => [pose.id, pose]));
  const layers = { target: true, source: true, poles: true, rejected: true, contradicting: true, ellipsoid: true, intensity: true };
  const state = { mode: "apart", pose: scene.poses.length ? scene.poses[0].id : null, T: IDENTITY, size: 1.5 };
  const [canvas, marks] = [$("#points"), $("#marks")];
  const webgl = canvas.getContext("webgl2", { antialias: false, alpha: false });
  const view = webgl ? webglView(canvas, webgl, marks, scene.clouds) : topView(canvas, marks, scene.clouds);
  if (!webgl) {
    $("#fallback").textContent = "This browser gives no WebGL: the clouds are shown from above.";
    $("#fallback").hidden = false;
  }
  root.dataset.view = view.kind;

  let width = 0, height = 0, onPaper = null;
  let ratio = () => Math.min(devicePixelRatio || 1, 2);

  function styleOf(plain) {
    return {
      ground: colour("--view"), colours: [colour("--target"), colour("--source")],
      text: `rgb(${colour("--text")})`, soft: `rgb(${colour("--soft")})`, faint: `rgb(${colour("--line")})`,
      denied: `rgb(${colour("--denied")})`,
      visible: [layers.target, layers.source], shade: layers.intensity ? 1 : 0,
      size: plain ? 0.8 : state.size, dpr: ratio(), layers, plain,
    };
  }

  function panes() {
    if (state.mode !== "apart") {
      return [{ x: 0, y: 0, w: width, h: height, frame: 0, poses: [IDENTITY, state.T],
        contradicting: state.mode === "after" ? scene.contradicting[state.pose] : null,
        ellipsoid: state.mode === "after" && state.pose === "result" }];
    }
    const wide = width > height * 1.2;
    const [w, h] = wide ? [Math.floor(width / 2), height] : [width, Math.floor(height / 2)];
    return [
      { x: 0, y: 0, w, h, frame: 0, poses: [IDENTITY, null], title: "target, in its own frame" },
      { x: wide ? w : 0, y: wide ? 0 : h, w: wide ? width - w : w, h: wide ? h : height - h,
        frame: 1, poses: [null, IDENTITY], title: "source, in its own frame" },
    ];
  }

  function paint() {
    const style = styleOf(false), parts = panes();
    view.paint(parts, style, height);
    const context = marks.getContext("2d");
    context.setTransform(style.dpr, 0, 0, style.dpr, 0, 0);
    context.clearRect(0, 0, width, height);
    for (const pane of parts) drawMarks(context, pane, view.lens(pane), scene, style);
    if (parts.length === 2) {
      const p = parts[1];
      context.fillStyle = style.faint;
      if (p.x) context.fillRect(p.x, 0, 1, height); else context.fillRect(0, p.y, width, 1);
    }
  }

  /** Draw every hypothesis in its panel, from where the main view looks. */
  function paintPanels() {
    const source = $("#points"), style = styleOf(true), dpr = style.dpr;
    for (const panel of all(".panel")) {
      const target = panel.querySelector("canvas"), box = onPaper ? PAPER.panel : target.getBoundingClientRect();
      const w = Math.min(Math.floor(box.width), width), h = Math.min(Math.floor(box.height), height);
      if (!w || !h) continue;
      const pane = { x: 0, y: 0, w, h, frame: 0, poses: [IDENTITY, poses.get(panel.dataset.pose).T],
        contradicting: scene.contradicting[panel.dataset.pose] };
      style.visible = [true, true];
      style.layers = { poles: true, contradicting: layers.contradicting };
      view.paint([pane], style, height);
      target.width = w * dpr;
      target.height = h * dpr;
      const context = target.getContext("2d");
      context.drawImage(source, 0, 0, w * dpr, h * dpr, 0, 0, w * dpr, h * dpr);
      context.setTransform(dpr, 0, 0, dpr, 0, 0);
      drawMarks(context, pane, view.lens(pane), scene, style);
    }
    paint();
  }

  let requested = false, later = 0;
  function repaint(withPanels = true) {
    if (!requested) { requested = true; requestAnimationFrame(() => { requested = false; paint(); }); }
    if (withPanels) { clearTimeout(later); later = setTimeout(paintPanels, 150); }
  }

  // --- poses: the source cloud moves smoothly from one to the next ---

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

  function describe() {
    if (state.mode === "apart") return "Apart: each cloud in its own frame.";
    if (state.mode === "before") return "Before: both clouds as recorded, as if they had one frame.";
    const pose = poses.get(state.pose);
    const shown = state.pose === "result" && scene.ellipsoid && layers.ellipsoid
      ? ` Ellipsoid: 1 σ of the source's position, enlarged ${scene.ellipsoid.factor.toLocaleString("en")} times.` : "";
    const caution = scene.status === "refused" ? " This run was refused: no hypothesis is its result." : "";
    const red = layers.contradicting && scene.contradicting[state.pose].some((points) => points.length)
      ? " Red: stands where the other LiDAR looked through." : "";
    return `After: source transformed by ${pose.id === "result" ? "the result" : pose.label}.${caution}${red}${shown}`;
  }
  function refresh() {
    root.dataset.mode = state.mode;
    root.dataset.pose = state.pose || "";
    all("[data-mode]").forEach((b) => { if (b.tagName === "BUTTON") b.setAttribute("aria-pressed", String(b.dataset.mode === state.mode)); });
    all("[data-layer]").forEach((b) => b.setAttribute("aria-pressed", String(layers[b.dataset.layer])));
    all(".panel").forEach((b) => b.setAttribute("aria-pressed", String(state.mode === "after" && b.dataset.pose === state.pose)));
    $("#pose").value = state.pose || "";
    $("#state").textContent = describe();
  }
  function setMode(mode) {
    if (mode === "after" && !state.pose) return;
    state.mode = mode;
    refresh();
    moveTo(goal());
  }
  function setPose(id) {
    if (!poses.has(id)) return;
    state.pose = id;
    setMode("after");
  }
  function toggle(layer) {
    layers[layer] = !layers[layer];
    refresh();
    repaint(layer === "intensity" || layer === "contradicting");
  }

  scene.placements.forEach((placement, k) => $("#placement").append(new Option(`${k + 1}: ${placement.files}`, k)));
  $(".placement").hidden = scene.placements.length < 2;
  $("#placement").addEventListener("change", (e) => {
    showPlacement(Number(e.target.value));
    view.load(scene.clouds);
    refresh();
    repaint();
  });
  for (const pose of scene.poses) $("#pose").append(new Option(pose.label, pose.id));
  $(".pose").hidden = !scene.poses.length;
  $('[data-mode="after"]').disabled = !scene.poses.length;
  $('[data-layer="ellipsoid"]').hidden = !scene.ellipsoid;
  $('[data-layer="rejected"]').hidden = !scene.placements.some((p) => p.rejected.flat().length);
  $('[data-layer="contradicting"]').hidden = !scene.placements.some(
    (p) => Object.values(p.contradicting).flat().some((points) => points.xyz));
  $('[data-layer="poles"]').hidden = !scene.placements.some((p) => p.poles.flat().length);
  $('[data-layer="intensity"]').hidden = !scene.clouds.some((c) => c.shown);
  for (const name of ["top", "side"]) $(`[data-preset="${name}"]`).hidden = view.kind === "top";
  all("button[data-mode]").forEach((b) => b.addEventListener("click", () => setMode(b.dataset.mode)));
  all("[data-layer]").forEach((b) => b.addEventListener("click", () => toggle(b.dataset.layer)));
  all("[data-preset]").forEach((b) => b.addEventListener("click", () => { view.preset(b.dataset.preset); repaint(); }));
  all(".panel").forEach((b) => b.addEventListener("click", () => {
    setPose(b.dataset.pose);
    const box = $(".stage").getBoundingClientRect();
    if (box.bottom < 200 || box.top > innerHeight - 200) $(".viewer").scrollIntoView();
  }));
  $("#pose").addEventListener("change", (e) => setPose(e.target.value));
  $("#size").addEventListener("input", (e) => { state.size = Number(e.target.value); repaint(false); });

  handOver(view, () => repaint());
  const layerKeys = { t: "target", s: "source", p: "poles", r: "rejected", c: "contradicting", e: "ellipsoid", i: "intensity" };
  document.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || e.target.closest("input, select, textarea, pre")) return;
    if (e.key === "b") setMode(state.mode === "before" ? "after" : "before");
    else if (e.key in layerKeys) toggle(layerKeys[e.key]);
    else if (e.key === "0") setPose("result");
    else if (/^[1-9]$/.test(e.key)) setPose(String.fromCharCode(96 + Number(e.key)));
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
  addEventListener("beforeprint", () => {
    onPaper ||= { theme: root.dataset.theme };
    root.dataset.theme = "light";
    const picture = $("#printed"), screenRatio = ratio;
    ratio = () => PAPER.dpr;
    resize(PAPER.width, PAPER.height, PAPER.dpr);
    paintPanels();
    [picture.width, picture.height] = [canvas.width, canvas.height];
    for (const layer of [canvas, marks]) picture.getContext("2d").drawImage(layer, 0, 0);
    picture.hidden = false;
    ratio = screenRatio;
  });
  addEventListener("afterprint", () => {
    if (!onPaper) return;
    if (onPaper.theme) root.dataset.theme = onPaper.theme; else delete root.dataset.theme;
    onPaper = null;
    resize(marks.clientWidth, marks.clientHeight, ratio());
    repaint();
  });

  state.mode = poses.has("result") ? "after" : "apart";
  state.T = goal();
  root.dataset.started = String(Math.round(started));
  refresh();
})();
