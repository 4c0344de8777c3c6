"use strict";
// Two painters of the same panes: WebGL through three.js, and a top view on a plain canvas.
// A pane is a rectangle of the canvas with the clouds to draw in it, each under its pose.
// Frame 0 is the site's or the target's, frame 1 the source's; each has a centre, an origin and a radius to look at.
// Poses are 4x4 row by row, points [x, y, z] in m.

const IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
const NEAR = 0.05;
const FIELD_OF_VIEW = 50;

function applyPose(T, p) {
  return [0, 1, 2].map((r) => T[r][0] * p[0] + T[r][1] * p[1] + T[r][2] * p[2] + T[r][3]);
}

function bytesOf(text) {
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let k = 0; k < binary.length; k++) bytes[k] = binary.charCodeAt(k);
  return bytes;
}

/** Decode what the page carries of a cloud; a point is low + size * xyz / 65535. */
function decodeCloud(packed) {
  const xyz = new Uint16Array(bytesOf(packed.xyz).buffer);
  const intensity = packed.intensity ? bytesOf(packed.intensity) : new Uint8Array(xyz.length / 3).fill(160);
  const levels = packed.levels && { ...packed.levels, values: new Uint16Array(bytesOf(packed.levels.values).buffer) };
  return { ...packed, xyz, intensity, levels, count: xyz.length / 3 };
}

/** One decoded point, metres. */
function pointOf({ xyz, low, size }, n) {
  return low.map((v, k) => v + (size[k] * xyz[3 * n + k]) / 65535);
}

/** Decode marked points into [x, y, z], metres. */
function decodePoints(packed) {
  const decoded = { ...packed, xyz: new Uint16Array(bytesOf(packed.xyz).buffer) };
  return Array.from({ length: decoded.xyz.length / 3 }, (_, n) => pointOf(decoded, n));
}

/** Pick the point of a cloud, in its frame, that is drawn nearest to a pixel, of those within `reach` pixels rather one in front; null if there is none. */
function pickPoint(cloud, lens, [x, y], reach) {
  let picked = null, least = Infinity;
  for (let n = 0; n < cloud.count; n++) {
    const v = lens.toView(pointOf(cloud, n));
    if (v[2] > -NEAR || -v[2] >= least) continue;
    const [a, b] = lens.toPixel(v), away = Math.hypot(a - x, b - y) / reach;
    if (away <= 1 && -v[2] * (1 + away) < least) [picked, least] = [n, -v[2] * (1 + away)];
  }
  return picked;
}

/** Rotation about z and translation from frame 0 to frame 1, so that both panes look past their sensor at the poles. */
function frameChange(frames) {
  if (frames.length < 2) return null;
  const [a, b] = frames.map((c) => Math.atan2(c.centre[1] - c.origin[1], c.centre[0] - c.origin[0]));
  const angle = b - a, cos = Math.cos(angle), sin = Math.sin(angle);
  const [p, q] = frames.map((frame) => frame.centre);
  const point = (x) => {
    const d = [x[0] - p[0], x[1] - p[1], x[2] - p[2]];
    return [q[0] + cos * d[0] - sin * d[1], q[1] + sin * d[0] + cos * d[1], q[2] + d[2]];
  };
  return { angle, point };
}

/** Where the camera starts: behind the sensor, above, looking at the poles. */
function presetOffset(name, { centre, origin, radius: r }) {
  const toPoles = [centre[0] - origin[0], centre[1] - origin[1]];
  const far = Math.hypot(...toPoles);
  const [x, y] = far > 0.1 ? toPoles.map((v) => -v / far) : [-1, 0];
  if (name === "top") return [0.001 * x, 0.001 * y, 1.9 * r];
  if (name === "side") return [-y * 1.5 * r, x * 1.5 * r, 0.12 * r];
  return [(0.85 * x - 0.45 * y) * 1.25 * r, (0.85 * y + 0.45 * x) * 1.25 * r, 0.75 * r];
}

const VERTEX = `
uniform float size, dpr, scale, limit;
uniform int poles;
attribute float intensity, strength;
varying float level, bright;
void main() {
  vec4 p = modelViewMatrix * vec4(position, 1.0);
  gl_Position = projectionMatrix * p;
  bright = step(limit, strength);
  bool marked = gl_VertexID < poles || bright > 0.5;
  level = marked ? 1.0 : intensity;
  gl_PointSize = dpr * clamp(size * scale / -p.z, 0.8 * size, 4.0 * size) * (bright > 0.5 ? 2.4 : marked ? 1.6 : 1.0);
}`;

const FRAGMENT = `
uniform vec3 colour, ground, lit;
uniform float shade;
varying float level, bright;
void main() {
  gl_FragColor = vec4(bright > 0.5 ? lit : mix(colour, mix(ground, colour, 0.4 + 0.6 * level), shade), 1.0);
}`;

/** Painter through WebGL; `pad` is the element that takes the pointer. */
function webglView(canvas, context, pad, clouds, frames) {
  const renderer = new THREE.WebGLRenderer({ canvas, context });
  renderer.autoClear = false;
  const camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, NEAR, 2000);
  const other = camera.clone();
  for (const c of [camera, other]) c.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(camera, pad);
  controls.screenSpacePanning = true;
  controls.enableZoom = false;
  controls.minDistance = 0.3;
  controls.maxDistance = 400;
  const scene = new THREE.Scene();
  let change, points = [];

  function makePoints(cloud) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(cloud.xyz, 3, true));
    geometry.setAttribute("intensity", new THREE.BufferAttribute(cloud.intensity, 1, true));
    if (cloud.levels) geometry.setAttribute("strength", new THREE.BufferAttribute(cloud.levels.values, 1, true));
    const uniforms = {};
    for (const name of ["size", "dpr", "scale", "shade", "limit"]) uniforms[name] = { value: 1 };
    uniforms.poles = { value: cloud.on_poles };
    for (const name of ["colour", "ground", "lit"]) uniforms[name] = { value: new THREE.Vector3() };
    const material = new THREE.ShaderMaterial({ uniforms, vertexShader: VERTEX, fragmentShader: FRAGMENT });
    const object = new THREE.Points(geometry, material);
    object.frustumCulled = false;
    object.matrixAutoUpdate = false;
    scene.add(object);
    return object;
  }

  function load(next, looked) {
    for (const object of points) {
      scene.remove(object);
      object.geometry.dispose();
      object.material.dispose();
    }
    [clouds, frames] = [next, looked];
    change = frameChange(frames);
    points = clouds.map(makePoints);
  }
  load(clouds, frames);

  function place(object, cloud, T) {
    const [s, l] = [cloud.size, cloud.low], at = applyPose(T, l);
    object.matrix.set(
      T[0][0] * s[0], T[0][1] * s[1], T[0][2] * s[2], at[0],
      T[1][0] * s[0], T[1][1] * s[1], T[1][2] * s[2], at[1],
      T[2][0] * s[0], T[2][1] * s[1], T[2][2] * s[2], at[2],
      0, 0, 0, 1);
    object.matrixWorldNeedsUpdate = true;
  }

  function cameraFor(pane) {
    let used = camera;
    if (pane.frame === 1) {
      used = other;
      const eye = change.point(camera.position.toArray()), at = change.point(controls.target.toArray());
      used.position.set(...eye);
      used.lookAt(...at);
    }
    used.aspect = pane.w / pane.h;
    used.updateProjectionMatrix();
    used.updateMatrixWorld();
    return used;
  }

  function preset(name) {
    const offset = presetOffset(name, frames[0]);
    controls.target.set(...frames[0].centre);
    camera.position.set(...frames[0].centre.map((v, k) => v + offset[k]));
    controls.update();
  }
  preset("oblique");

  return {
    kind: "webgl",
    preset,
    load,
    onMove: (f) => controls.addEventListener("change", f),
    onSettle: (f) => controls.addEventListener("end", f),
    allowWheel: (on) => { controls.enableZoom = on; },
    resize: (w, h, dpr) => { renderer.setPixelRatio(dpr); renderer.setSize(w, h, false); },
    orbit(azimuthStep, elevationStep) {
      const d = camera.position.clone().sub(controls.target), r = d.length();
      const azimuth = Math.atan2(d.y, d.x) + azimuthStep;
      const elevation = Math.max(-1.5, Math.min(1.5, Math.asin(d.z / r) + elevationStep));
      d.set(r * Math.cos(elevation) * Math.cos(azimuth), r * Math.cos(elevation) * Math.sin(azimuth), r * Math.sin(elevation));
      camera.position.copy(controls.target).add(d);
      controls.update();
    },
    zoom(factor) {
      camera.position.sub(controls.target).multiplyScalar(factor).add(controls.target);
      controls.update();
    },
    lens(pane) {
      const used = cameraFor(pane), m = used.matrixWorldInverse.elements.slice();
      const f = 1 / Math.tan((FIELD_OF_VIEW * Math.PI) / 360), aspect = pane.w / pane.h;
      return {
        toView: (p) => [0, 1, 2].map((r) => m[r] * p[0] + m[r + 4] * p[1] + m[r + 8] * p[2] + m[r + 12]),
        toPixel: (v) => [
          pane.x + (pane.w / 2) * (1 + ((f / aspect) * v[0]) / -v[2]),
          pane.y + (pane.h / 2) * (1 - (f * v[1]) / -v[2]),
        ],
      };
    },
    paint(panes, style, height) {
      const [r, g, b] = style.ground;
      renderer.setScissorTest(true);
      for (const pane of panes) {
        const bottom = height - pane.y - pane.h;
        renderer.setViewport(pane.x, bottom, pane.w, pane.h);
        renderer.setScissor(pane.x, bottom, pane.w, pane.h);
        points.forEach((object, k) => {
          const T = pane.poses[k];
          object.visible = Boolean(T) && style.visible[k];
          if (!object.visible) return;
          place(object, clouds[k], T);
          const u = object.material.uniforms;
          u.size.value = style.size;
          u.scale.value = pane.h / 60;
          u.dpr.value = style.dpr;
          u.shade.value = style.shade;
          u.limit.value = style.limits[k];
          u.lit.value.set(...style.bright.map((v) => v / 255));
          u.colour.value.set(...style.colours[k].map((v) => v / 255));
          u.ground.value.set(r / 255, g / 255, b / 255);
        });
        renderer.setClearColor((r << 16) | (g << 8) | b);
        renderer.clear();
        renderer.render(scene, cameraFor(pane));
      }
    },
  };
}

/** Painter without WebGL: the clouds from above, on a 2-D canvas. */
function topView(canvas, pad, clouds, frames) {
  const context = canvas.getContext("2d");
  const listeners = { move: [], settle: [] };
  const notify = (what) => listeners[what].forEach((f) => f());
  let centre, span, wheel = false, dpr = 1;
  let change, metres;

  function load(next, looked) {
    [clouds, frames] = [next, looked];
    change = frameChange(frames);
    metres = clouds.map((c) => Float32Array.from(c.xyz, (v, k) => c.low[k % 3] + (c.size[k % 3] * v) / 65535));
  }
  load(clouds, frames);

  function preset() { centre = frames[0].centre.slice(); span = 2.2 * frames[0].radius; notify("move"); }
  preset();

  let from = null;
  pad.addEventListener("pointerdown", (e) => { from = [e.clientX, e.clientY]; pad.setPointerCapture(e.pointerId); });
  pad.addEventListener("pointermove", (e) => {
    if (!from) return;
    const perPixel = span / Math.min(pad.clientWidth, pad.clientHeight);
    centre[0] -= (e.clientX - from[0]) * perPixel;
    centre[1] += (e.clientY - from[1]) * perPixel;
    from = [e.clientX, e.clientY];
    notify("move");
  });
  for (const name of ["pointerup", "pointercancel"]) {
    pad.addEventListener(name, () => { from = null; notify("settle"); });
  }
  pad.addEventListener("wheel", (e) => {
    if (!wheel) return;
    e.preventDefault();
    span *= Math.exp(e.deltaY / 500);
    notify("move");
  }, { passive: false });

  /** Affine map of a pane: pixel = origin + A (x, y). */
  function affine(pane) {
    const scale = Math.min(pane.w, pane.h) / span;
    const [c, angle] = pane.frame === 1 ? [change.point(centre), -change.angle] : [centre, 0];
    const cos = Math.cos(angle) * scale, sin = Math.sin(angle) * scale;
    const A = [cos, -sin, -sin, -cos];
    const at = [pane.x + pane.w / 2 - A[0] * c[0] - A[1] * c[1], pane.y + pane.h / 2 - A[2] * c[0] - A[3] * c[1]];
    return { A, at };
  }

  return {
    kind: "top",
    preset,
    load,
    onMove: (f) => listeners.move.push(f),
    onSettle: (f) => listeners.settle.push(f),
    allowWheel: (on) => { wheel = on; },
    resize(w, h, ratio) { dpr = ratio; canvas.width = w * dpr; canvas.height = h * dpr; },
    orbit(right, up) { centre[0] += right * span * 0.5; centre[1] += up * span * 0.5; notify("move"); },
    zoom(factor) { span *= factor; notify("move"); },
    lens(pane) {
      const { A, at } = affine(pane);
      return {
        toView: (p) => [p[0], p[1], -1],
        toPixel: (v) => [at[0] + A[0] * v[0] + A[1] * v[1], at[1] + A[2] * v[0] + A[3] * v[1]],
      };
    },
    paint(panes, style) {
      const dot = Math.max(1, Math.round(style.size * dpr));
      for (const pane of panes) {
        const w = Math.round(pane.w * dpr), h = Math.round(pane.h * dpr);
        const image = context.createImageData(w, h), pixels = new Uint32Array(image.data.buffer);
        const pack = (c) => (255 << 24) | (c[2] << 16) | (c[1] << 8) | c[0];
        pixels.fill(pack(style.ground));
        const { A, at } = affine(pane);
        clouds.forEach((cloud, k) => {
          const T = pane.poses[k];
          if (!T || !style.visible[k]) return;
          const shades = Array.from({ length: 256 }, (_, v) => {
            const level = 1 - style.shade * 0.6 * (1 - v / 255);
            return pack(style.colours[k].map((c, n) => Math.round(style.ground[n] + (c - style.ground[n]) * level)));
          });
          const xyz = metres[k], strength = cloud.levels?.values, limit = 65535 * style.limits[k], lit = pack(style.bright);
          for (let n = 0; n < cloud.count; n++) {
            const x = xyz[3 * n], y = xyz[3 * n + 1], z = xyz[3 * n + 2];
            const X = T[0][0] * x + T[0][1] * y + T[0][2] * z + T[0][3];
            const Y = T[1][0] * x + T[1][1] * y + T[1][2] * z + T[1][3];
            const u = ((at[0] - pane.x + A[0] * X + A[1] * Y) * dpr) | 0;
            const v = ((at[1] - pane.y + A[2] * X + A[3] * Y) * dpr) | 0;
            if (u < 0 || v < 0 || u >= w - dot || v >= h - dot) continue;
            const value = strength && strength[n] >= limit ? lit : shades[cloud.intensity[n]];
            for (let b = 0; b < dot; b++) for (let a = 0; a < dot; a++) pixels[(v + b) * w + u + a] = value;
          }
        });
        context.putImageData(image, Math.round(pane.x * dpr), Math.round(pane.y * dpr));
      }
    },
  };
}

/** What draws lines, labels and spots over the points, each with a halo in the colour of the ground. */
function penFor(context, lens, ground) {
  const halo = `rgba(${ground.join(",")},0.85)`;
  function trace(points) {
    context.beginPath();
    let open = false, before = null;
    for (const p of points) {
      const v = lens.toView(p);
      if (before && (before[2] > -NEAR) !== (v[2] > -NEAR)) {
        const s = (-NEAR - before[2]) / (v[2] - before[2]);
        const cut = lens.toPixel([0, 1, 2].map((k) => (k === 2 ? -NEAR : before[k] + s * (v[k] - before[k]))));
        if (open) context.lineTo(...cut); else context.moveTo(...cut);
        open = !open;
      }
      if (v[2] <= -NEAR) {
        if (open) context.lineTo(...lens.toPixel(v)); else context.moveTo(...lens.toPixel(v));
        open = true;
      }
      before = v;
    }
  }
  function line(points, colour, width, dash = [], edge = 3) {
    trace(points);
    context.strokeStyle = halo;
    context.lineWidth = width + edge;
    context.stroke();
    context.setLineDash(dash);
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.stroke();
    context.setLineDash([]);
  }
  function spot(p) {
    const v = lens.toView(p);
    return v[2] <= -NEAR ? lens.toPixel(v) : null;
  }
  const taken = [];
  /** Write a label; an optional one only where it covers no other. */
  function label(text, at, colour, align = "left", size = 12, optional = false) {
    const half = 0.33 * size * text.length;
    const centre = at[0] + (align === "left" ? half : align === "right" ? -half : 0);
    const overlaps = ([x, y, w, h]) => Math.abs(x - centre) < w + half && Math.abs(y - at[1]) < h + size / 2;
    if (optional && taken.some(overlaps)) return;
    taken.push([centre, at[1], half, size / 2]);
    context.font = `600 ${size}px system-ui, sans-serif`;
    context.textAlign = align;
    context.textBaseline = "middle";
    context.lineWidth = 4;
    context.lineJoin = "round";
    context.strokeStyle = halo;
    context.strokeText(text, ...at);
    context.fillStyle = colour;
    context.fillText(text, ...at);
  }
  return { halo, trace, line, spot, label };
}

/** Draw what lies over the points: range circles, sensors, poles, marked points, rejected clusters, the ellipsoid. */
function drawMarks(context, pane, lens, scene, loaded, style) {
  const { halo, trace, line, spot, label } = penFor(context, lens, style.ground);
  const css = (lidar) => `rgb(${style.ofLidar[lidar].join(",")})`;
  const { layers, plain } = style, named = layers.names && !plain, near = scene.kind !== "site";
  // Of recordings the points are looked at, and not where the poles of two LiDARs coincide.
  const slim = scene.kind === "recordings" ? 0.5 : 1;
  const shown = loaded.map((cloud, n) => ({ cloud, T: pane.poses[n] })).filter(({ T }, n) => T && style.visible[n]);
  const side = (lidar) => (lidar % 2 ? 1 : -1);
  context.save();
  context.beginPath();
  context.rect(pane.x, pane.y, pane.w, pane.h);
  context.clip();
  context.lineCap = "round";

  /** Draw a pole; of two LiDARs the first one's line is the wider, so that both are seen where they coincide. */
  function drawPole(ends, text, colour, lidar) {
    const first = scene.kind === "pair" && lidar === 0;
    line(ends, colour, (first ? 7 : 3) * (plain ? 0.6 : slim), [], first ? 3 : 1);
    const seen = ends.map(spot).filter(Boolean).sort((p, q) => p[1] - q[1])[0];
    if (seen && named) label(text, [seen[0] + 8 * side(lidar), seen[1] - 10], colour, lidar % 2 ? "left" : "right", near ? 13 : 11, !near);
  }

  const base = loaded.find((cloud) => pane.poses[loaded.indexOf(cloud)]);
  for (const range of plain || !near || !base ? [] : [5, 10, 20, 40]) {
    const [x, y, z] = base.decoded.origin;
    context.strokeStyle = style.faint;
    context.lineWidth = 1;
    trace(Array.from({ length: 97 }, (_, k) => {
      const angle = (2 * Math.PI * k) / 96;
      return [x + range * Math.cos(angle), y + range * Math.sin(angle), z];
    }));
    context.stroke();
    const at = spot([x, y + range, z]);
    if (at) { context.font = "11px system-ui, sans-serif"; context.fillStyle = style.soft; context.textAlign = "center"; context.fillText(`${range} m`, at[0], at[1] - 5); }
  }
  const ellipsoid = pane.ellipsoid && layers.ellipsoid ? scene.ellipsoid : null;
  const circles = !ellipsoid ? [] : [[0, 1], [1, 2], [2, 0]].map(([i, j]) => Array.from({ length: 49 }, (_, k) => {
    const a = (2 * Math.PI * k) / 48, { centre, axes } = ellipsoid;
    return centre.map((v, n) => v + Math.cos(a) * axes[i][n] + Math.sin(a) * axes[j][n]);
  }));
  pane.sensors.forEach((T, k) => {
    if (!T || !style.lidars[k]) return;
    const cloud = loaded.find((each) => each.lidar === k), o = cloud ? cloud.decoded.origin : [0, 0, 0];
    const to = (p) => applyPose(T, p), colour = css(k), inside = ellipsoid && k === 1;
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]].forEach((axis, n) => {
      const end = to(o.map((v, m) => v + axis[m]));
      line([to(o), end], colour, plain ? 1 : 2, n === 2 ? [] : n === 1 ? [5, 4] : [1, 4], inside ? 0 : 3);
      const at = near && !plain ? spot(end) : null;
      if (at) label("xyz"[n], at, colour, "center", 11);
    });
    const at = plain ? null : spot(to(o));
    if (!at) return;
    for (const circle of inside ? circles : []) {
      trace(circle);
      context.globalAlpha = 0.16;
      context.fillStyle = style.text;
      context.fill();
      context.globalAlpha = 1;
      context.strokeStyle = style.text;
      context.lineWidth = 1;
      context.stroke();
    }
    const low = inside ? Math.max(...circles.flat().map(spot).filter(Boolean).map((p) => p[1]), at[1]) : at[1] + 2;
    if (layers.names) label(scene.lidars[k].name, [at[0], low + 12], colour, "center");
    if (inside) label(`1 σ × ${ellipsoid.factor.toLocaleString("en")}`, [at[0], low + 26], style.text, "center", 11);
  });
  for (const pole of layers.poles ? scene.poles : []) {
    if (style.places[pole.placement]) drawPole([pole.a, pole.b], pole.label, style.text, 1);
  }
  for (const place of pane.sensors[0] && style.lidars[0] && !plain ? scene.places : []) {
    // A place that alone decides a direction of the pose: a circle, and its share of the information.
    const c = spot(place.at);
    if (!c) continue;
    for (const [width, stroke] of [[4, halo], [2, style.contradicting]]) {
      context.beginPath();
      context.arc(c[0], c[1], 11, 0, 2 * Math.PI);
      context.lineWidth = width;
      context.strokeStyle = stroke;
      context.stroke();
    }
    label(`decides ${place.label}`, [c[0], c[1] - 16], style.contradicting, "center", 12);
  }
  for (const { cloud, T } of shown) {
    const to = (p) => applyPose(T, p), lidar = cloud.lidar, colour = css(lidar);
    for (const pole of layers.poles && !scene.poles.length ? cloud.poles : []) drawPole([to(pole.a), to(pole.b)], pole.label, colour, lidar);
    const spots = (layers.contradicting && cloud.denying[pane.id] || []).map((p) => spot(to(p))).filter(Boolean);
    for (const [size, fill] of plain ? [[2, style.contradicting]] : [[6, halo], [4, style.contradicting]]) {
      context.fillStyle = fill;
      for (const [x, y] of spots) context.fillRect(x - size / 2, y - size / 2, size, size);
    }
    for (const cluster of layers.rejected && !plain ? cloud.rejected : []) {
      const c = spot(to(cluster.at));
      if (!c) continue;
      const arms = lidar % 2 ? [[7 * slim, 0], [0, 7 * slim]] : [[5 * slim, 5 * slim], [5 * slim, -5 * slim]];  // + and ×
      for (const [width, stroke] of [[5 * slim, halo], [2.5 * slim, colour]]) {
        context.beginPath();
        for (const [x, y] of arms) { context.moveTo(c[0] - x, c[1] - y); context.lineTo(c[0] + x, c[1] + y); }
        context.lineWidth = width; context.strokeStyle = stroke; context.stroke();
      }
      label(cluster.label, [c[0] + 9 * side(lidar), c[1] - 8], colour, lidar % 2 ? "left" : "right", 11, true);
    }
  }
  if (pane.title) label(pane.title, [pane.x + 12, pane.y + 18], style.text, "left", 13);
  context.restore();
}
