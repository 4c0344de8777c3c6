"use strict";
// The page of a site: every cloud under the pose of its LiDAR, LiDARs and placements on and off.
(() => {
  const started = performance.now();
  const scene = JSON.parse($("#data").textContent);
  let repaint = () => {};
  setUpPage(() => repaint());

  // What is folded is on paper all the same: the poses are what it is printed for.
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = all("details.lidar:not([open])");
    for (const part of folded) part.open = true;
  });
  addEventListener("afterprint", () => { for (const part of folded) part.open = false; });

  root.dataset.started = String(Math.round(started));
  if (!scene) { root.dataset.usable = String(Math.round(performance.now())); return; }

  // --- the view ---

  /** A refused site has no poses: one LiDAR at a time is shown, in its own frame. */
  const together = scene.status !== "refused";
  const first = scene.clouds[0];
  const state = {
    lidars: scene.lidars.map((_, k) => together || k === first.lidar),
    places: scene.placements.map((_, k) => k === first.placement),
    layers: { poles: true, names: true, intensity: true },
    size: 1.5,
  };
  const empty = { xyz: new Uint16Array(0), intensity: new Uint8Array(0), count: 0, on_poles: 0, low: [0, 0, 0], size: [1, 1, 1] };

  const isOn = (cloud) => state.lidars[cloud.lidar] && state.places[cloud.placement];
  /** Clouds that were shown until now: a recording is decoded when it is shown for the first time. */
  let held = [];
  function base() {
    if (together) {
      const [x, y, z] = scene.centre;
      return { ...empty, centre: scene.centre, origin: [x + scene.radius, y, z], radius: scene.radius };
    }
    const shown = held.find(isOn) || held[0];
    return { ...shown.decoded, ...empty };
  }
  function hold() {
    const before = held.length;
    for (const cloud of scene.clouds) if (isOn(cloud)) cloud.decoded ||= decodeCloud(cloud.points);
    held = scene.clouds.filter((cloud) => cloud.decoded);
    return held.length !== before;
  }
  // The first that the view is given holds no points: it says where the camera looks.
  const handed = () => [base(), ...held.map((cloud) => cloud.decoded)];

  hold();
  const [canvas, marks] = [$("#points"), $("#marks")];
  const webgl = canvas.getContext("webgl2", { antialias: false, alpha: false });
  const view = webgl ? webglView(canvas, webgl, marks, handed()) : topView(canvas, marks, handed());
  if (!webgl) {
    $("#fallback").textContent = "This browser gives no WebGL: the clouds are shown from above.";
    $("#fallback").hidden = false;
  }
  root.dataset.view = view.kind;

  let width = 0, height = 0, onPaper = null;
  let ratio = () => Math.min(devicePixelRatio || 1, 2);

  const colourOf = (lidar) => colour(`--lidar-${scene.lidars[lidar].colour}`);
  const poseOf = (lidar) => scene.lidars[lidar].T || IDENTITY;

  function drawLidar(pen, k) {
    const T = poseOf(k), to = (p) => applyPose(T, p), css = `rgb(${colourOf(k).join(",")})`;
    const cloud = held.find((each) => each.lidar === k), o = cloud ? cloud.decoded.origin : [0, 0, 0];
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]].forEach((axis, n) => {
      const end = to(o.map((v, m) => v + 0.8 * axis[m]));
      pen.line([to(o), end], css, 2, n === 2 ? [] : n === 1 ? [5, 4] : [1, 4]);
    });
    const at = pen.spot(to(o));
    if (at && state.layers.names) pen.label(scene.lidars[k].name, [at[0], at[1] + 14], css, "center", 13);
  }
  function drawPole(pen, a, b, text, css) {
    pen.line([a, b], css, 3, [], 2);
    const seen = [a, b].map(pen.spot).filter(Boolean).sort((p, q) => p[1] - q[1])[0];
    if (seen && state.layers.names) pen.label(text, [seen[0] + 6, seen[1] - 9], css, "left", 11, true);
  }
  function paint() {
    const ground = colour("--view"), dpr = ratio();
    const pane = { x: 0, y: 0, w: width, h: height, frame: 0, poses: [null, ...held.map((cloud) => poseOf(cloud.lidar))] };
    const lens = view.lens(pane), context = marks.getContext("2d");
    view.paint([pane], {
      ground, dpr, size: state.size, shade: state.layers.intensity ? 1 : 0,
      visible: [false, ...held.map(isOn)], colours: [ground, ...held.map((cloud) => colourOf(cloud.lidar))],
    }, height);
    context.setTransform(dpr, 0, 0, dpr, 0, 0);
    context.clearRect(0, 0, width, height);
    context.lineCap = "round";
    const pen = penFor(context, lens, ground), text = `rgb(${colour("--text")})`;
    scene.lidars.forEach((_, k) => { if (state.lidars[k]) drawLidar(pen, k); });
    if (!state.layers.poles) return;
    if (together) {
      for (const pole of scene.poles) if (state.places[pole.placement]) drawPole(pen, pole.a, pole.b, pole.label, text);
    } else {
      for (const cloud of held.filter(isOn)) for (const pole of cloud.poles) drawPole(pen, pole.a, pole.b, pole.label, text);
    }
  }

  let requested = false;
  repaint = () => {
    if (!requested) { requested = true; requestAnimationFrame(() => { requested = false; paint(); }); }
  };

  function describe() {
    const names = scene.lidars.filter((_, k) => state.lidars[k]).map((lidar) => lidar.name);
    const places = scene.placements.filter((_, k) => state.places[k]);
    const what = names.length === scene.lidars.length ? `all ${names.length} LiDARs` : names.join(", ") || "no LiDAR";
    const when = places.length ? `placement ${places.join(", ")}` : "no placement";
    if (together) return `Shown: ${what}; ${when}.`;
    const none = scene.clouds.some(isOn) ? "" : " It recorded nothing there.";
    return `Refused, so there are no poses: ${what} alone, in its own frame; ${when}.${none}`;
  }
  function refresh() {
    for (const [name, list] of [["lidar", state.lidars], ["place", state.places]]) {
      all(`[data-${name}]`).forEach((b) => b.setAttribute("aria-pressed", String(list[Number(b.dataset[name])])));
    }
    all("[data-layer]").forEach((b) => b.setAttribute("aria-pressed", String(state.layers[b.dataset.layer])));
    root.dataset.lidars = state.lidars.map(Number).join("");
    root.dataset.places = state.places.map(Number).join("");
    $("#state").textContent = describe();
    const isNew = hold();
    if (isNew || !together) view.load(handed());
    if (!together) view.preset("oblique");
    repaint();
  }
  function toggle(list, k) {
    if (k >= list.length) return;
    if (together) list[k] = !list[k]; else list.forEach((_, n) => { list[n] = n === k; });
    refresh();
  }
  function toggleLayer(layer) { state.layers[layer] = !state.layers[layer]; refresh(); }

  all("[data-lidar]").forEach((b) => b.addEventListener("click", () => toggle(state.lidars, Number(b.dataset.lidar))));
  all("[data-place]").forEach((b) => b.addEventListener("click", () => toggle(state.places, Number(b.dataset.place))));
  all("[data-layer]").forEach((b) => b.addEventListener("click", () => toggleLayer(b.dataset.layer)));
  all("[data-preset]").forEach((b) => b.addEventListener("click", () => { view.preset(b.dataset.preset); repaint(); }));
  for (const name of ["top", "side"]) $(`[data-preset="${name}"]`).hidden = view.kind === "top";
  $("#size").addEventListener("input", (e) => { state.size = Number(e.target.value); repaint(); });

  handOver(view, () => repaint());
  const layerKeys = { p: "poles", n: "names", i: "intensity" };
  document.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.metaKey || e.altKey || e.target.closest("input, select, textarea, pre")) return;
    // With Shift, a key gives the sign above its digit: its place on the keyboard says which it is.
    const digit = /^(?:Digit|Numpad)([1-9])$/.exec(e.code);
    if (digit) toggle(e.shiftKey ? state.places : state.lidars, Number(digit[1]) - 1);
    else if (/^[1-9]$/.test(e.key)) toggle(state.lidars, Number(e.key) - 1);
    else if (e.key in layerKeys) toggleLayer(layerKeys[e.key]);
    else if (e.key === "a" && together) { state.lidars.fill(true); refresh(); }
  });

  view.onMove(() => repaint());
  view.onSettle(() => repaint());
  new ResizeObserver(() => {
    if (onPaper) return;
    resize(marks.clientWidth, marks.clientHeight, ratio());
    paint();
    if (!root.dataset.usable) root.dataset.usable = String(Math.round(performance.now()));
  }).observe(marks);

  // --- paper: light colours, and a picture whose shape is not the window's ---

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
    paint();
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
  refresh();
})();
