// A map of runs over two of the sliders, filled in the background by workers, coarse cells first.
"use strict";

// The end of a run for readers: a run without its event may have it after the horizon of the page.
function wordFor(word, horizon) {
  return word === "illegal" ? "not possible" : word.startsWith("not_") ? `not within ${Number(horizon.toPrecision(4))} s` : word.replace(/_/g, " ");
}

function makeMap(box, live, integrator, choose) {
  const across = 40, up = 30, levels = [8, 4, 2, 1], chunk = 24;
  const { sliders, words, answer } = live.facts;
  // A single slider has no map.
  if (sliders.length < 2) {
    box.hidden = true;
    return { update() {}, results: () => [], done: () => true, cells: [], at: () => [] };
  }
  const [canvas, legend, selects] = [box.querySelector("canvas"), box.querySelector("#legend"), box.querySelectorAll("select")];
  const colours = { not_inverted: "#dde1e6", not_reversed: "#dde1e6", completed: "#dde1e6", contact_lost: "#e9a23b", failed: "#c8412b", jammed: "#8c5a3c",
    does_not_fit: "#7b4fa3", unresolved: "#c8412b", rank_lost: "#7b4fa3", illegal: "#ffffff" };
  const stops = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

  // Every cell once, beginning with the cells of the coarsest grid.
  const cells = levels.flatMap((level, k) => {
    const found = [];
    for (let y = 0; y < up; y += level) for (let x = 0; x < across; x += level)
      if (k === 0 || x % levels[k - 1] || y % levels[k - 1]) found.push({ x, y, level });
    return found;
  });
  let values = sliders.map((slider) => slider.value), axes = [0, 1], results = [], round = 0, next = 0;

  // Each worker gets a program made from the page's own text, so that the page works from disk.
  const text = (part) => typeof part === "function" ? String(part) : Array.isArray(part) ? `[${part.map(text)}]`
    : part && typeof part === "object" ? `{${Object.entries(part).map(([key, inner]) => `${key}: ${text(inner)}`)}}` : JSON.stringify(part);
  const program = `${integrator}
    const work = integrator(${text(live.answer)}), allowed = ${live.allowed};
    onmessage = ({ data: { round, first, runs } }) => postMessage({ round, first, found: runs.map((values) =>
      allowed(values, [])[0] ? (work.run(values), work.read("outcome", values)) : [null, Infinity]) });`;
  const workers = [];
  try {
    const address = URL.createObjectURL(new Blob([program], { type: "text/javascript" }));
    const count = Math.max(1, Math.min(4, (navigator.hardwareConcurrency || 2) - 1));
    for (let k = 0; k < count; k++) workers.push(new Worker(address));
  } catch (error) {
    legend.textContent = "There is no map, because this browser does not allow workers for pages on disk.";
  }
  const place = (slider, part) => slider.low + part * (slider.high - slider.low);
  const at = (cell) => values.map((value, k) => k === axes[1] ? place(sliders[k], (cell.y + 0.5) / up)
    : k === axes[0] ? place(sliders[k], (cell.x + 0.5) / across) : value);

  function feed(worker) {
    worker.idle = next >= cells.length;
    if (worker.idle) return;
    worker.postMessage({ round, first: next, runs: cells.slice(next, next + chunk).map(at) });
    next += chunk;
  }
  for (const worker of workers) {
    worker.idle = true;
    worker.onmessage = ({ data }) => {
      if (data.round === round) {
        data.found.forEach((one, k) => { results[data.first + k] = one; });
        redraw();
      }
      feed(worker);
    };
  }

  function colour(part) {
    const k = Math.min(stops.length - 2, Math.floor(part * (stops.length - 1))), rest = part * (stops.length - 1) - k;
    return `rgb(${stops[k].map((low, c) => Math.round(low + rest * (stops[k + 1][c] - low))).join(",")})`;
  }
  const short = (number) => Number(number.toPrecision(3)).toString();
  let drawing = false;
  function redraw() {
    if (drawing) return;
    drawing = true;
    requestAnimationFrame(() => { drawing = false; draw(); });
  }
  const left = 48, bottom = 38;
  // Lines at 45 degrees over a part of the map whose runs have no number, so that no colour of a number looks alike.
  function hatch(pen, x, y, w, h) {
    pen.save();
    pen.beginPath(); pen.rect(x, y, w, h); pen.clip();
    Object.assign(pen, { strokeStyle: "#6b7280", lineWidth: 1 });
    pen.beginPath();
    for (let at = 6 * Math.ceil((x - y - h) / 6); at < x + w - y; at += 6) { pen.moveTo(at + y, y); pen.lineTo(at + y + h, y + h); }
    pen.stroke();
    pen.restore();
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width) return;
    [canvas.width, canvas.height] = [width * ratio, height * ratio];
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const [w, h] = [width - left - 2, height - bottom - 2];
    const known = results.filter(Boolean), finite = known.map((one) => one[1]).filter(Number.isFinite);
    const [low, high] = [Math.min(...finite), Math.max(...finite)];
    pen.fillStyle = "#f3f4f6";
    pen.fillRect(left, 2, w, h);
    cells.forEach((cell, k) => {
      if (!results[k]) return;
      const [status, value] = results[k];
      pen.fillStyle = Number.isFinite(value) ? colour(high > low ? (value - low) / (high - low) : 0.5) : colours[words[status]] || "#ffffff";
      // Round to whole pixels, so that there are no visible seams.
      const [x0, x1] = [cell.x, Math.min(across, cell.x + cell.level)].map((x) => Math.round(left + (x / across) * w));
      const [y0, y1] = [cell.y, Math.min(up, cell.y + cell.level)].map((y) => Math.round(2 + h - (y / up) * h));
      pen.fillRect(x0, y1, x1 - x0, y0 - y1);
      if (!Number.isFinite(value)) hatch(pen, x0, y1, x1 - x0, y0 - y1);
    });
    const [first, second] = axes.map((k) => sliders[k]);
    pen.fillStyle = "#23262b";
    pen.font = "13px system-ui, sans-serif";
    const label = (one) => one.label + (one.unit ? ` [${one.unit}]` : "");
    const [ends, sides] = [first, second].map(({ low, high, factor }) => [low, high].map((end) => short(factor * end)));
    pen.textAlign = "left"; pen.fillText(ends[0], left, height - 22);
    pen.textAlign = "right"; pen.fillText(ends[1], left + w, height - 22);
    pen.fillText(sides[1], left - 5, 11); pen.fillText(sides[0], left - 5, 2 + h);
    pen.textAlign = "center"; pen.fillText(label(first), left + w / 2, height - 5);
    pen.save(); pen.translate(11, 2 + h / 2); pen.rotate(-Math.PI / 2); pen.fillText(label(second), 0, 0); pen.restore();
    const x = left + ((values[axes[0]] - first.low) / (first.high - first.low)) * w;
    const y = 2 + h - ((values[axes[1]] - second.low) / (second.high - second.low)) * h;
    for (const [style, thick] of [["#ffffff", 4], ["#23262b", 2]]) {
      pen.strokeStyle = style; pen.lineWidth = thick;
      pen.beginPath(); pen.arc(x, y, 6, 0, 7); pen.stroke();
    }
    showLegend(known, low, high);
  }
  function showLegend(known, low, high) {
    if (!workers.length) return;
    const entry = (...parts) => { const span = document.createElement("span"); span.append(...parts); return span; };
    legend.replaceChildren();
    if (low <= high) {
      const scale = Object.assign(document.createElement("span"), { className: "scale" }), shades = [0, 0.25, 0.5, 0.75, 1].map(colour).join(",");
      scale.style.background = `linear-gradient(90deg,${shades})`;
      legend.append(entry(answer.label), entry(short(low), scale, `${short(high)}\u00a0${answer.unit}`));
    }
    for (const status of new Set(known.filter((one) => !Number.isFinite(one[1])).map((one) => one[0]))) {
      const word = words[status] || "illegal", box = Object.assign(document.createElement("canvas"), { width: 13, height: 13 }), pen = box.getContext("2d");
      pen.fillStyle = colours[word] || "#ffffff";
      pen.fillRect(0, 0, 13, 13);
      hatch(pen, 0, 0, 13, 13);
      box.setAttribute("aria-hidden", "true");
      legend.append(entry(box, wordFor(word, answer.horizon)));
    }
  }

  // Start the map again if a slider that is not one of its axes has moved.
  function update(now, force = false) {
    const other = force || now.some((value, k) => value !== values[k] && !axes.includes(k));
    values = [...now];
    if (other) {
      [results, next] = [[], 0];
      round += 1;
      workers.filter((worker) => worker.idle).forEach(feed);
    }
    redraw();
  }
  function setAxes(first, second) {
    axes = [first, second];
    selects.forEach((select, k) => { select.value = axes[k]; });
    update(values, true);
  }
  selects.forEach((select, k) => {
    sliders.forEach((slider, number) => select.add(new Option(`${k ? "↑" : "→"} ${slider.label}`, number)));
    select.addEventListener("change", () => {
      const wanted = Number(select.value), other = axes[1 - k];
      // Two equal axes would give a line, so exchange them instead.
      const [first, second] = k === 0 ? [wanted, wanted === other ? axes[0] : other] : [wanted === other ? axes[1] : other, wanted];
      setAxes(first, second);
    });
  });
  function pick(event) {
    const frame = canvas.getBoundingClientRect(), part = (number) => Math.min(1, Math.max(0, number));
    const parts = [part((event.clientX - frame.left - left) / (frame.width - left - 2)),
      part(1 - (event.clientY - frame.top - 2) / (frame.height - bottom - 2))];
    choose(values.map((value, k) => k === axes[1] ? place(sliders[k], parts[1]) : k === axes[0] ? place(sliders[k], parts[0]) : value));
  }
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); pick(event); });
  canvas.addEventListener("pointermove", (event) => { if (event.buttons) pick(event); });
  // The arrows move the marked run by a cell of the map.
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowRight: [1, 0], ArrowLeft: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!step || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    const moved = (k, part) => values[k] + part * (sliders[k].high - sliders[k].low);
    choose(values.map((value, k) => k === axes[1] ? moved(k, step[1] / up) : k === axes[0] ? moved(k, step[0] / across) : value));
  });
  window.addEventListener("resize", redraw);
  setAxes(...axes);
  return { update, results: () => results, done: () => results.filter(Boolean).length === cells.length, cells, at };
}
