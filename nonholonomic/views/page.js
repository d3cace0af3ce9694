// Moves what K3D draws: a slider for the time, play, speed, and strips of curves. Python wrote `facts` and `numbers`.
"use strict";
(async () => {
  const text = (id) => document.getElementById(id).textContent;
  const bytes = (coded) => Uint8Array.from(atob(coded), (letter) => letter.charCodeAt(0));
  const inflated = (coded) =>
    new Response(new Blob([bytes(coded)]).stream().pipeThrough(new DecompressionStream("deflate")));

  const facts = JSON.parse(text("facts"));
  const buffer = await (await inflated(text("numbers"))).arrayBuffer();
  const array = ([begin, length]) => new Float32Array(buffer, 4 * begin, length);

  let k3d;
  const define = (name, needs, make) => { k3d = make(); };
  // K3D's program, as its Python package carries it.
  new Function("define", await (await inflated(text("library"))).text())(define);

  const element = (kind, parent, properties = {}) => parent.appendChild(Object.assign(document.createElement(kind), properties));
  const root = document.getElementById("view");
  const stagesBox = element("div", root, { id: "stages" });
  const controls = element("div", root, { id: "controls" });
  const stripsBox = element("div", root, { id: "strips" });

  // Where a time lies among the times of a run: the index before it, and how far it is towards the next.
  function place(times, time) {
    let low = 0, high = times.length - 1;
    if (high < 1 || time <= times[0]) return [0, 0];
    if (time >= times[high]) return [high - 1, 1];
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= time) low = middle; else high = middle;
    }
    return [low, (time - times[low]) / (times[high] - times[low])];
  }
  const point = (values, [k, part]) =>
    [0, 1, 2].map((c) => (values.length > 3 ? (1 - part) * values[3 * k + c] + part * values[3 * k + 3 + c] : values[c]));
  function turning(values, [k, part]) {
    const a = values.subarray(4 * k, 4 * k + 4), b = values.length > 4 ? values.subarray(4 * k + 4, 4 * k + 8) : a;
    let cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    const sign = cosine < 0 ? -1 : 1;
    cosine = Math.min(1, Math.abs(cosine));
    const angle = Math.acos(cosine), sine = Math.sin(angle);
    const [p, q] = sine < 1e-4 ? [1 - part, part] : [Math.sin((1 - part) * angle) / sine, Math.sin(part * angle) / sine];
    const mixed = [0, 1, 2, 3].map((c) => p * a[c] + sign * q * b[c]);
    const length = Math.hypot(...mixed);
    return mixed.map((c) => c / length);
  }

  function move(object, origin, quaternion, lengths = [1, 1, 1]) {
    object.position.set(...origin);
    object.quaternion.set(...quaternion);
    object.scale.set(...lengths);
    object.matrixAutoUpdate = false;
    object.updateMatrix();
    object.updateMatrixWorld(true);
  }
  // The quaternion that turns z towards a vector.
  function towards([x, y, z]) {
    const length = Math.hypot(x, y, z);
    if (z < -0.999999 * length) return [1, 0, 0, 0];
    const found = [-y, x, 0, length + z], norm = Math.hypot(...found);
    return found.map((c) => c / norm);
  }
  const upright = [0, 0, 0, 1];

  const stages = [];
  for (const stage of facts.stages) {
    const figure = element("figure", stagesBox);
    const scene = element("div", figure, { className: "scene" });
    const caption = element("figcaption", figure);
    element("b", caption, { textContent: stage.title });
    for (const [words, colour] of stage.keys) {
      const key = element("span", caption, { className: "key" });
      if (colour) element("i", key).style.background = colour;
      key.append(words);
    }
    const plot = await k3d.CreateK3DAndLoadBinarySnapshot(bytes(text(stage.snapshot)), scene);
    const shows = stage.shows.map((show) => ({
      ...show,
      times: array(show.times),
      bodies: show.bodies.map((one) => ({ ...one, position: array(one.position), turning: array(one.turning) })),
      traces: show.traces.map((one) => ({ ...one, about: one.about && array(one.about) })),
      arrows: show.arrows.map((one) => ({ ...one, start: array(one.start), vector: array(one.vector) })),
      curves: show.curves.map((one) => ({ ...one, values: array(one.values) })),
    }));
    const world = plot.getWorld();
    stages.push({ plot, world, shows, size: stage.size, follow: stage.follow, focus: null, span: null, find: (id) => world.ObjectsById[id] });
  }

  function show(stage, run, time) {
    const at = place(run.times, time);
    for (const body of run.bodies) {
      const [origin, quaternion] = [point(body.position, at), turning(body.turning, at)];
      for (const id of body.ids) move(stage.find(id), origin, quaternion);
    }
    for (const trace of run.traces) {
      const line = stage.find(trace.id);
      if (trace.about) move(line, point(trace.about, at), upright);
      line.geometry.setDrawRange(0, 6 * Math.round(at[0] + at[1]));
    }
    for (const arrow of run.arrows) {
      const vector = point(arrow.vector, at), start = point(arrow.start, at), length = Math.hypot(...vector);
      const head = Math.min(arrow.head, 0.6 * length), shaft = length - head, quaternion = towards(vector);
      const [rod, tip] = [stage.find(arrow.shaft), stage.find(arrow.tip)];
      rod.visible = tip.visible = length > 0.02 * arrow.head;
      move(rod, start, quaternion, [1, 1, Math.max(shaft, 1e-9)]);
      move(tip, start.map((c, k) => c + (length > 0 ? vector[k] * shaft / length : 0)), quaternion,
        Array(3).fill(Math.max(head / arrow.head, 1e-9)));
    }
    return at;
  }

  // The strips: one for each label, with the curves of all runs in it.
  const labels = [...new Set(stages.flatMap((s) => s.shows.flatMap((run) => run.curves.map((one) => one.label))))];
  const strips = labels.map((label) => {
    const box = element("div", stripsBox, { className: "strip" });
    const head = element("div", box, { className: "head" });
    element("span", head, { textContent: label });
    const value = element("span", head, { className: "value" });
    const canvas = element("canvas", box);
    const curves = stages.flatMap((s) => s.shows.flatMap((run) => run.curves.filter((one) => one.label === label)
      .map((one) => ({ times: run.times, values: one.values, colour: run.colour }))));
    let low = Infinity, high = -Infinity;
    for (const one of curves) for (const v of one.values) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
    // What is constant but for round-off is drawn as a constant.
    const least = 1e-3 * Math.max(Math.abs(low), Math.abs(high)) || 1;
    if (!(high - low > least)) { low -= least; high += least; }
    return { canvas, curves, value, low, high, pale: null, strong: null };
  });
  const digits = (v) => (v === 0 ? "0" : Math.abs(v) < 1e-3 || Math.abs(v) >= 1e5 ? v.toExponential(2) : v.toPrecision(4));
  const left = 58, foot = 4;

  function paint(strip) {
    const { canvas } = strip, ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth * ratio, height = canvas.clientHeight * ratio;
    canvas.width = width; canvas.height = height;
    const [x0, x1, y0, y1] = [left * ratio, width - 4 * ratio, height - foot * ratio, 6 * ratio];
    const x = (t) => x0 + (t / facts.duration) * (x1 - x0);
    const y = (v) => y0 + ((v - strip.low) / (strip.high - strip.low)) * (y1 - y0);
    const drawn = (alpha, thick) => {
      const layer = Object.assign(document.createElement("canvas"), { width, height }), pen = layer.getContext("2d");
      pen.globalAlpha = alpha; pen.lineWidth = thick * ratio; pen.lineJoin = "round";
      for (const one of strip.curves) {
        pen.strokeStyle = one.colour; pen.beginPath();
        let down = false;
        one.values.forEach((v, k) => {
          if (!Number.isFinite(v)) { down = false; return; }
          if (down) pen.lineTo(x(one.times[k]), y(v)); else pen.moveTo(x(one.times[k]), y(v));
          down = true;
        });
        pen.stroke();
      }
      return layer;
    };
    Object.assign(strip, { x, y, x0, x1, y0, y1, ratio, pale: drawn(0.28, 1), strong: drawn(1, 1.5) });
  }

  function draw(strip) {
    if (!strip.pale) paint(strip);
    const { canvas, x0, x1, y0, y1, ratio } = strip, pen = canvas.getContext("2d"), now = strip.x(time);
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.fillStyle = "#6b7280"; pen.font = `${11 * ratio}px system-ui, sans-serif`; pen.textAlign = "right";
    pen.fillText(digits(strip.high), x0 - 6 * ratio, y1 + 6 * ratio);
    pen.fillText(digits(strip.low), x0 - 6 * ratio, y0);
    pen.strokeStyle = "#dde1e6"; pen.lineWidth = ratio; pen.strokeRect(x0, y1, x1 - x0, y0 - y1);
    pen.drawImage(strip.pale, 0, 0);
    pen.save(); pen.beginPath(); pen.rect(0, 0, now, canvas.height); pen.clip(); pen.drawImage(strip.strong, 0, 0); pen.restore();
    pen.strokeStyle = "#23262b"; pen.beginPath(); pen.moveTo(now, y0); pen.lineTo(now, y1); pen.stroke();
    strip.value.textContent = "";
    for (const one of strip.curves) {
      const [k, part] = place(one.times, time), v = one.values[Math.round(k + part)];
      element("span", strip.value, { textContent: ` ${Number.isFinite(v) ? digits(v) : "-"}` }).style.color = one.colour;
      if (Number.isFinite(v) && time <= one.times[one.times.length - 1] + 1e-9) {
        pen.fillStyle = one.colour; pen.beginPath(); pen.arc(now, strip.y(v), 3 * ratio, 0, 7); pen.fill();
      }
    }
  }

  const button = element("button", controls, { id: "play", textContent: "▶ play", title: "space" });
  const slider = element("input", controls, { id: "slider", type: "range", min: 0, max: facts.duration, step: "any", value: 0 });
  const clock = element("span", controls, { id: "clock" });
  const speeds = element("select", controls, { id: "speed", title: "speed" });
  for (const [words, factor] of facts.speeds) {
    element("option", speeds, { textContent: words, value: factor, selected: factor === facts.speed });
  }
  const followLabel = element("label", controls, { textContent: "camera follows " });
  const follow = element("input", followLabel, { type: "checkbox", id: "follow", checked: facts.stages.some((one) => one.follow) });

  let time = 0, playing = false, before = null;
  function seek(wanted) {
    time = Math.min(Math.max(wanted, 0), facts.duration);
    for (const stage of stages) {
      const places = stage.shows.map((run) => show(stage, run, time));
      // The middle of all runs, and so far back that all are seen.
      const at = stage.shows.map((run, k) => point(run.bodies[0].position, places[k]));
      const focus = [0, 1, 2].map((k) => at.reduce((sum, one) => sum + one[k], 0) / at.length);
      const span = 3.6 * stage.size + Math.max(...at.map((one) => Math.hypot(...one.map((x, k) => x - focus[k]))));
      if (stage.focus && follow.checked) {
        const { camera, controls: handle } = stage.world;
        ["x", "y", "z"].forEach((axis, k) => {
          const away = (camera.position[axis] - handle.target[axis]) * span / stage.span;
          handle.target[axis] += focus[k] - stage.focus[k];
          camera.position[axis] = handle.target[axis] + away;
        });
        handle.update();
      }
      [stage.focus, stage.span] = [focus, span];
      stage.plot.render();
    }
    strips.forEach(draw);
    slider.value = time;
    clock.textContent = `${time.toFixed(3)} s of ${facts.duration.toFixed(2)} s`;
  }
  function play(wanted) {
    playing = wanted;
    button.textContent = playing ? "❚❚ pause" : "▶ play";
    if (playing && time >= facts.duration) seek(0);
    before = null;
    if (playing) requestAnimationFrame(step);
  }
  function step(now) {
    if (!playing) return;
    if (before !== null) seek(time + ((now - before) / 1000) * Number(speeds.value));
    before = now;
    if (time >= facts.duration) play(false); else requestAnimationFrame(step);
  }
  button.addEventListener("click", () => play(!playing));
  slider.addEventListener("input", () => { play(false); seek(Number(slider.value)); });
  document.addEventListener("keydown", (event) => {
    if (event.code === "Space" && event.target.tagName !== "BUTTON") { event.preventDefault(); play(!playing); }
  });
  window.addEventListener("resize", () => { strips.forEach((strip) => { strip.pale = null; draw(strip); }); });

  // K3D sets the camera a moment after it has loaded.
  await new Promise((done) => setTimeout(done, 50));
  seek(0);
  // What is drawn where, for whoever wants to look: a body's 4 x 4 matrix in the scene, column after column.
  window.player = {
    seek, play, stages,
    time: () => time,
    playing: () => playing,
    matrix: (stage, run, body, part = 0) =>
      [...stages[stage].find(stages[stage].shows[run].bodies[body].ids[part]).matrixWorld.elements],
  };
})();
