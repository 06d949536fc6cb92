// Turns objects: parts move rigidly about the stored axes and pivots. No library, no request.
"use strict";

// An element; what is put inside of it is text, whatever it holds.
function node(name, attributes = {}, ...inside) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes))
    key in made ? (made[key] = value) : made.setAttribute(key, value);
  made.append(...inside);
  return made;
}

// Fills a card that has a stage, with a picture for who cannot draw; `noted` is called after changes.
function turn(page, scene, noted = () => {}) {
  const canvas = node("canvas", {
    tabIndex: 0, role: "img",
    "aria-label": `${scene.name} in three dimensions. Drag or use the arrow keys to turn it, plus and minus to come closer; the sliders beside move its joints.`,
  });
  const controls = controlled();
  const { sliders, step, axes, labels, fault } = controls;
  page.querySelector(".stage").prepend(canvas);
  page.append(controls.panel);
  const CREASE = Math.cos((28 * Math.PI) / 180);
  const FOV = (26 * Math.PI) / 180;
  const LAMPS = 8; // of which each throws a hard shadow; together they are soft

  // --- what parts do: 4x4 matrices by columns, as WebGL has them -------------------------------

  const identity = () => [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

  function product(a, b) {
    const out = new Array(16).fill(0);
    for (let c = 0; c < 4; c++)
      for (let r = 0; r < 4; r++)
        for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
    return out;
  }

  function moved(joint, q) {
    const [x, y, z] = joint.axis;
    const T = identity();
    if (!joint.revolute) return [...T.slice(0, 12), q * x, q * y, q * z, 1];
    const c = Math.cos(q), s = Math.sin(q), v = 1 - c;
    const R = [
      [c + x * x * v, x * y * v - z * s, x * z * v + y * s],
      [y * x * v + z * s, c + y * y * v, y * z * v - x * s],
      [z * x * v - y * s, z * y * v + x * s, c + z * z * v],
    ];
    R.forEach((row, r) => {
      row.forEach((value, k) => (T[4 * k + r] = value));
      T[12 + r] = joint.pivot[r] - row.reduce((sum, value, k) => sum + value * joint.pivot[k], 0);
    });
    return T;
  }

  // Of each part from the canonical pose, for joint states in radians and lengths of the unit frame.
  function motions(states) {
    const found = [identity()];
    const of = (part) =>
      (found[part] ??= product(of(scene.joints[part - 1].parent), moved(scene.joints[part - 1], states[part - 1])));
    return scene.parts.map((_, part) => of(part));
  }

  const states = () => sliders.map((slider, j) => Number(slider.value) / scene.joints[j].unit);

  // --- meshes ----------------------------------------------------------------------------------

  async function unpacked(base64) {
    const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
    const data = new Uint8Array(await new Response(stream).arrayBuffer());
    let at = 0;
    const take = (count, size) => {
      const out = size === 2 ? new Uint16Array(count) : new Uint32Array(count);
      let before = 0;
      for (let i = 0; i < count; i++) {
        let step = 0;
        for (let b = 0; b < size; b++) step |= data[at + b * count + i] << (8 * b);
        out[i] = before = size === 2 ? (before + step) & 0xffff : (before + step) >>> 0;
      }
      at += size * count;
      return out;
    };
    return scene.parts.map((part) => {
      const axes = [0, 1, 2].map(() => take(part.vertices, 2));
      const points = new Float32Array(3 * part.vertices);
      axes.forEach((axis, k) => axis.forEach((value, i) => (points[3 * i + k] = value / 32767.5 - 1)));
      return { points, corners: take(3 * part.faces, 4) };
    });
  }

  // Every corner by itself (x, y, z, normal): faces that meet in a crease keep their own normals.
  function creased({ points, corners }) {
    const faces = corners.length / 3;
    const across = new Float32Array(3 * faces), unit = new Float32Array(3 * faces);
    for (let f = 0; f < faces; f++) {
      const [a, b, c] = [0, 1, 2].map((k) => 3 * corners[3 * f + k]);
      const u = [0, 1, 2].map((k) => points[b + k] - points[a + k]);
      const v = [0, 1, 2].map((k) => points[c + k] - points[a + k]);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const length = Math.hypot(...n) || 1e-12;
      for (let k = 0; k < 3; k++) {
        across[3 * f + k] = n[k];
        unit[3 * f + k] = n[k] / length;
      }
    }
    const first = new Uint32Array(points.length / 3 + 1);
    corners.forEach((v) => first[v + 1]++);
    for (let v = 0; v < first.length - 1; v++) first[v + 1] += first[v];
    const fill = first.slice(), around = new Uint32Array(corners.length);
    corners.forEach((v, at) => (around[fill[v]++] = Math.floor(at / 3)));
    const out = new Float32Array(6 * corners.length);
    corners.forEach((v, at) => {
      const f = 3 * Math.floor(at / 3);
      let x = 0, y = 0, z = 0;
      for (let n = first[v]; n < first[v + 1]; n++) {
        const g = 3 * around[n];
        if (unit[f] * unit[g] + unit[f + 1] * unit[g + 1] + unit[f + 2] * unit[g + 2] < CREASE) continue;
        (x += across[g]), (y += across[g + 1]), (z += across[g + 2]);
      }
      const length = Math.hypot(x, y, z) || 1e-12;
      out.set([points[3 * v], points[3 * v + 1], points[3 * v + 2], x / length, y / length, z / length], 6 * at);
    });
    return out;
  }

  // A rod with a knob at the pivot: what an axis looks like.
  function rod(joint) {
    const out = [], SIDES = 12;
    const a = joint.axis, least = a.map(Math.abs).indexOf(Math.min(...a.map(Math.abs)));
    const e = [0, 1, 2].map((k) => (k === least ? 1 : 0));
    const cross = (p, q) => [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
    let u = cross(a, e);
    u = u.map((value) => value / Math.hypot(...u));
    const v = cross(a, u);
    const ring = (along, radius, k) => {
      const t = (2 * Math.PI * k) / SIDES, c = Math.cos(t), s = Math.sin(t);
      const n = [0, 1, 2].map((i) => c * u[i] + s * v[i]);
      return [...[0, 1, 2].map((i) => joint.pivot[i] + along * a[i] + radius * n[i]), ...n];
    };
    const tube = (low, high, from, to) => {
      for (let k = 0; k < SIDES; k++) {
        const [p, q, r, s] = [ring(low, from, k), ring(low, from, k + 1), ring(high, to, k + 1), ring(high, to, k)];
        out.push(...p, ...q, ...r, ...p, ...r, ...s);
      }
    };
    const L = 0.62 * scene.radius, w = 0.006 * scene.radius;
    tube(joint.revolute ? -L : 0, L, w, w);
    tube(L, L + 12 * w, 4 * w, 0);
    for (let k = 0; k < 6; k++) {
      const [p, q] = [(k * Math.PI) / 6, ((k + 1) * Math.PI) / 6];
      tube(-4 * w * Math.cos(p), -4 * w * Math.cos(q), 4 * w * Math.sin(p), 4 * w * Math.sin(q));
    }
    return new Float32Array(out);
  }

  // --- drawing ---------------------------------------------------------------------------------

  const VERTEX = `#version 300 es
    layout(location = 0) in vec3 point;
    layout(location = 1) in vec3 normal;
    uniform mat4 view, part;
    uniform vec4 lamp; // the floor's height in w; all zero where no shadow is drawn
    out vec3 facing, place;
    void main() {
      vec4 at = part * vec4(point, 1.0);
      if (lamp.z > 0.0) at.xyz -= lamp.xyz * (at.z - lamp.w) / lamp.z;
      facing = mat3(part) * normal;
      place = at.xyz;
      gl_Position = view * at;
    }`;
  const FRAGMENT = `#version 300 es
    precision highp float;
    in vec3 facing, place;
    uniform vec3 colour, eye, key;
    uniform float alpha, flat_;
    out vec4 pixel;
    void main() {
      vec3 n = normalize(facing), toward = normalize(eye - place);
      float inner = gl_FrontFacing ? 1.0 : 0.55;
      if (!gl_FrontFacing) n = -n;
      float lit = 0.40 + 0.14 * n.z + 0.50 * max(dot(n, key), 0.0) + 0.12 * max(dot(n, toward), 0.0);
      vec3 c = mix(colour * lit * inner, colour, flat_);
      pixel = vec4(pow(c, vec3(1.0 / 2.2)) * alpha, alpha);
    }`;

  function compiled(gl) {
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  const linear = (colour) =>
    [1, 3, 5].map((at) => Math.pow(parseInt(colour.slice(at, at + 2), 16) / 255, 2.2));

  function uploaded(gl, corners) {
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    for (const at of [0, 1]) {
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 24, 12 * at);
    }
    return { array, count: corners.length / 6 };
  }

  const camera = { azimuth: scene.azimuth, elevation: 0.42, zoom: 1 }, home = { ...camera };

  function eyeAndView(aspect) {
    const { azimuth: a, elevation: e } = camera;
    const back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const right = [-Math.sin(a), Math.cos(a), 0];
    const up = [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)];
    const narrow = Math.min(1, aspect);
    const distance = scene.radius / Math.sin(Math.atan(Math.tan(FOV / 2) * narrow)) / camera.zoom;
    const eye = scene.middle.map((m, k) => m + distance * back[k]);
    const dot = (p) => p.reduce((sum, value, k) => sum + value * eye[k], 0);
    const look = [
      right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right), -dot(up), -dot(back), 1,
    ];
    const f = 1 / Math.tan(FOV / 2), near = distance * 0.05, far = distance + 6 * scene.radius;
    const project = [
      f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1,
      0, 0, (2 * far * near) / (near - far), 0,
    ];
    return { eye, right, up, back, view: product(project, look) };
  }

  function started(meshes) {
    const gl = canvas.getContext("webgl2", { antialias: true, stencil: true });
    if (!gl) throw new Error("This browser has no WebGL 2");
    const program = compiled(gl);
    gl.useProgram(program);
    const at = (name) => gl.getUniformLocation(program, name);
    const where = Object.fromEntries(
      ["view", "part", "lamp", "colour", "eye", "key", "alpha", "flat_"].map((name) => [name, at(name)]));
    const parts = meshes.map((mesh) => uploaded(gl, creased(mesh)));
    const rods = scene.joints.map((joint) => uploaded(gl, rod(joint)));
    const colours = scene.parts.map((part) => linear(part.colour));

    const put = (body, T, colour) => {
      gl.uniformMatrix4fv(where.part, false, T);
      gl.uniform3fv(where.colour, colour);
      gl.bindVertexArray(body.array);
      gl.drawArrays(gl.TRIANGLES, 0, body.count);
    };

    function shadows(T) {
      gl.enable(gl.STENCIL_TEST);
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
      gl.depthMask(false);
      gl.uniform1f(where.flat_, 1);
      gl.uniform1f(where.alpha, 0.04);
      for (let n = 0; n < LAMPS; n++) {
        gl.stencilFunc(gl.NOTEQUAL, n + 1, 0xff); // each lamp darkens a pixel once
        const t = (2 * Math.PI * n) / LAMPS;
        gl.uniform4f(where.lamp, 0.11 * Math.cos(t) + 0.08, 0.11 * Math.sin(t) - 0.1, 1, scene.floor - 0.004);
        parts.forEach((body, k) => put(body, T[k], [0, 0, 0]));
      }
      gl.uniform4f(where.lamp, 0, 0, 0, 0);
      gl.depthMask(true);
      gl.disable(gl.STENCIL_TEST);
    }

    function rodsThrough(T) {
      gl.uniform1f(where.flat_, 0.35);
      for (const [test, alpha] of [[false, 0.35], [true, 1]]) {
        test ? gl.enable(gl.DEPTH_TEST) : gl.disable(gl.DEPTH_TEST);
        gl.uniform1f(where.alpha, alpha);
        rods.forEach((body, j) => put(body, T[scene.joints[j].parent], colours[j + 1].map((c) => 0.55 * c)));
      }
      gl.disable(gl.BLEND);
    }

    forget = () => gl.getExtension("WEBGL_lose_context")?.loseContext();
    draw = () => {
      const density = Math.min(window.devicePixelRatio || 1, 2);
      canvas.width = Math.max(1, Math.round(canvas.clientWidth * density));
      canvas.height = Math.max(1, Math.round(canvas.clientHeight * density));
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      const { eye, right, up, back, view } = eyeAndView(canvas.width / canvas.height);
      const key = [0, 1, 2].map((k) => -0.45 * right[k] + 0.65 * up[k] + 0.6 * back[k]);
      gl.uniformMatrix4fv(where.view, false, view);
      gl.uniform3fv(where.eye, eye);
      gl.uniform3fv(where.key, key.map((value) => value / Math.hypot(...key)));
      gl.uniform4f(where.lamp, 0, 0, 0, 0);
      const T = motions(states());
      if (camera.elevation > 0) shadows(T);
      gl.disable(gl.BLEND);
      gl.uniform1f(where.flat_, 0);
      gl.uniform1f(where.alpha, 1);
      parts.forEach((body, k) => put(body, T[k], colours[labels.checked ? k : 0]));
      if (axes.checked) {
        gl.enable(gl.BLEND);
        rodsThrough(T);
      }
    };
  }

  // --- what people do --------------------------------------------------------------------------

  function controlled() {
    const dot = (colour) => {
      const mark = node("span", { className: "dot", ariaHidden: "true" });
      mark.style.background = colour;
      return mark;
    };
    const ranged = (title, about, range, ...below) => {
      const slider = node("input", { type: "range", "aria-label": title, ...range });
      return [slider, node("div", { className: "joint" },
        node("div", { className: "name" }, ...about, title, node("output")), slider, ...below)];
    };
    const checked = (title) => {
      const box = node("input", { type: "checkbox", checked: true });
      return [box, node("label", { className: "check" }, box, title)];
    };
    const button = (title, more) => node("button", { type: "button", ...more }, title);
    const count = scene.states.length;
    const joints = scene.joints.map((joint, j) =>
      ranged(joint.name, [dot(scene.parts[j + 1].colour)],
        { min: joint.low, max: joint.high, step: "any", value: joint.start, defaultValue: joint.start },
        node("p", { className: "hint" }, joint.text)));
    const [step, steps] = ranged("Stored state", [], { min: 1, max: count, step: 1, value: 1 });
    const [axes, showAxes] = checked("Axes and pivots");
    const [labels, showLabels] = checked("Part colours");
    const [reset, all, stored] = [
      button("Reset"), button("Move all", { ariaPressed: "false" }), button("Play stored states", { ariaPressed: "false" })];
    const named = scene.parts.filter((part) => part.name);
    const fault = node("p", { className: "hint", role: "status" });
    const panel = node("div", { className: "controls" },
      node("h3", {}, `${scene.name} `, node("small", { className: "hint" }, scene.split)),
      node("div", { className: "buttons" }, reset, all, ...(count > 1 ? [stored] : [])),
      ...joints.map(([, joint]) => joint), ...(count > 1 ? [steps] : []), showAxes, showLabels,
      node("p", { className: "hint legend" },
        ...named.map((part) => node("span", {}, dot(part.colour), ` ${part.name}`))),
      node("p", { className: "hint" },
        "Drag to turn; arrow keys, + and − work too. Click the picture, then scroll to zoom."), fault);
    return { panel, sliders: joints.map(([slider]) => slider), step, axes, labels, reset, all, stored, fault };
  }

  let draw = () => {}, forget = () => {}, playing = null, awaited = false, closed = false;

  const redraw = () => {
    noted();
    if (awaited) return;
    awaited = true;
    requestAnimationFrame(() => ((awaited = false), draw()));
  };
  const written = (slider, text) => {
    slider.setAttribute("aria-valuetext", text);
    slider.parentElement.querySelector("output").value = text;
  };
  const put = (values) => {
    values.slice(0, sliders.length).forEach((value, j) => {
      sliders[j].value = value;
      const now = Number(sliders[j].value);
      written(sliders[j], scene.joints[j].revolute ? `${now.toFixed(0)}°` : `${Number(now.toPrecision(3))}`);
    });
    const alike = (state) => state.every((q, j) => Math.abs(q - values[j]) <= 1e-3 * (scene.joints[j].high - scene.joints[j].low));
    const count = scene.states.length;
    const at = alike(scene.states[step.value - 1]) ? step.value - 1 : scene.states.findIndex(alike);
    if (at >= 0) step.value = at + 1;
    written(step, at < 0 ? `none of ${count}` : `${at + 1} of ${count}`);
    redraw();
  };
  const current = () => sliders.map((slider) => Number(slider.value));
  const look = (azimuth, elevation, zoom) => {
    camera.azimuth = azimuth;
    camera.elevation = Math.max(-0.5, Math.min(1.5, elevation));
    camera.zoom = Math.max(0.5, Math.min(8, zoom));
    redraw();
  };
  const turned = (azimuth, elevation) =>
    look(camera.azimuth + azimuth, camera.elevation + elevation, camera.zoom);
  const zoom = (factor) => look(camera.azimuth, camera.elevation, camera.zoom * factor);

  function attended() {
    const { all, stored, reset } = controls;
    sliders.forEach((slider) => slider.addEventListener("input", () => put(current())));
    for (const box of [axes, labels]) box.addEventListener("change", redraw);
    step.addEventListener("input", () => put(scene.states[step.value - 1]));
    const play = (button, at) => {
      const run = (playing = playing?.button === button ? null : { button });
      for (const one of [all, stored]) one.ariaPressed = String(one === playing?.button);
      const begun = performance.now();
      const frame = (now) => {
        if (!run || playing !== run) return;
        put(at(Math.max(0, now - begun) / 1000));
        requestAnimationFrame(frame);
      };
      requestAnimationFrame(frame);
    };
    const back_and_forth = (seconds) => scene.joints.map(({ low, high }, j) =>
      low + (high - low) * (0.5 - 0.5 * Math.cos(Math.max(seconds - 0.25 * j, 0) * 1.3)));
    all.addEventListener("click", () => play(all, back_and_forth));
    stored.addEventListener("click", () => play(stored, (seconds) => {
      const count = scene.states.length, at = Math.floor(seconds) % count;
      const share = Math.min(1, 1.6 * (seconds % 1)), next = scene.states[(at + 1) % count];
      return scene.states[at].map((q, j) => q + (next[j] - q) * share * share * (3 - 2 * share));
    }));
    reset.addEventListener("click", () => {
      look(home.azimuth, home.elevation, home.zoom);
      put(scene.joints.map((joint) => joint.start));
    });

    const fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const now = [event.clientX, event.clientY];
      if (fingers.size === 2) {
        const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, xy]) => xy);
        const apart = (xy) => Math.hypot(xy[0] - other[0], xy[1] - other[1]);
        zoom(apart(now) / Math.max(apart(before), 1));
      } else turned(-0.009 * (now[0] - before[0]), 0.009 * (now[1] - before[1]));
      fingers.set(event.pointerId, now);
    });
    for (const end of ["pointerup", "pointercancel"])
      canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return; // the page scrolls until the picture is chosen
      event.preventDefault();
      zoom(Math.exp(-0.0015 * event.deltaY));
    }, { passive: false });
    const keys = {
      ArrowLeft: () => turned(-0.12, 0), ArrowRight: () => turned(0.12, 0),
      ArrowUp: () => turned(0, 0.08), ArrowDown: () => turned(0, -0.08),
      "+": () => zoom(1.15), "=": () => zoom(1.15), "-": () => zoom(1 / 1.15),
    };
    canvas.addEventListener("keydown", (event) => {
      if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      keys[event.key]();
    });
    new ResizeObserver(redraw).observe(canvas);
    put(current());
  }

  attended();
  (async () => {
    try {
      if (!window.DecompressionStream) throw new Error("This browser is too old to unpack the meshes");
      const meshes = await unpacked(scene.meshes);
      if (closed) return; // nobody would give its WebGL context back
      started(meshes);
      draw();
      page.dataset.ready = "true";
    } catch (error) {
      fault.textContent = `${error.message}; the picture beside shows how it stands.`;
      page.dataset.failed = "true";
    }
  })();
  return {
    motions, states, view: () => eyeAndView(canvas.width / canvas.height).view,
    get: () => ({ joints: current(), camera: Object.values(camera) }),
    set: (joints, place) => (put(joints), look(...place)),
    close: () => ((closed = true), (playing = null), forget()),
  };
}

// A report has one object, within itself.
const only = document.getElementById("scene");
if (only) window.articugen = turn(document.getElementById("viewer"), JSON.parse(only.textContent));
