// Sliders that simulate again while they move: the result as text, the run for the player, the map, and the page's address.
"use strict";
(async () => {
  const { facts, answer, motion, allowed } = window.live, { sliders, words } = facts, { layout } = motion;
  const [asks, moves] = [integrator(answer), integrator(motion)];
  // The names and units of the curves, and the factors that convert their values to these units.
  const [{ shows: [{ curves }] }] = JSON.parse(document.getElementById("facts").textContent).stages;
  const box = document.getElementById("explore"), result = document.getElementById("result");
  const element = (kind, parent, properties = {}) => parent.appendChild(Object.assign(document.createElement(kind), properties));
  const initial = sliders.map((slider) => slider.value);
  let values = [...initial], player = null, median = [];

  const digits = (number, count = 4) => !Number.isFinite(number) ? "–" : number === 0 ? "0"
    : Math.abs(number) < 1e-3 || Math.abs(number) >= 1e5 ? number.toExponential(count - 1)
      : Math.abs(number) >= 10 ** count ? String(Math.round(number)) : number.toPrecision(count);
  // A value in the unit of the page, and in degrees or revolutions per minute if that is the SI unit.
  function withUnit(value, { name, unit, factor }) {
    const other = unit === "rad" ? `${digits((180 * value) / Math.PI, 3)} deg` : unit === "rad/s" && name.endsWith("spin") ? `${Math.round((30 * value) / Math.PI)} rpm` : "";
    return `${digits(factor * value, 3)} ${unit}${other && ` = ${other}`}`;
  }
  const knobs = sliders.map((slider, k) => {
    const label = element("label", document.getElementById("knobs")), title = element("span", label, { textContent: slider.label });
    const shown = element("output", label);
    // Without a name of its own, the slider would be called by its value, too.
    const input = element("input", label, { type: "range", min: 0, max: 1000, step: 1, name: slider.name, ariaLabel: slider.label });
    input.addEventListener("input", () => {
      const part = Number(input.value) / 1000;
      set(values.map((value, j) => (j === k ? slider.low + part * (slider.high - slider.low) : value)), input);
    });
    return { input, shown, title };
  });

  // The run in the form for the player, with at most `most` frames.
  function recorded(most) {
    const run = moves.trajectory(values, "frame"), first = run.read([0])[0];
    const frames = Math.round(Math.min(most, Math.max(300, (run.end * first[first.length - 1]) / 0.4)));
    const times = Float64Array.from({ length: frames }, (_, k) => (run.end * k) / (frames - 1)), rows = run.read(times);
    let column = 0;
    const take = (width) => {
      const found = new Float64Array(width * frames);
      rows.forEach((row, k) => { for (let c = 0; c < width; c++) found[width * k + c] = row[column + c]; });
      column += width;
      return found;
    };
    const list = (count, make) => Array.from({ length: count }, (_, k) => make(k));
    return {
      times,
      normal: take(3),
      bodies: list(layout.bodies, () => ({ position: take(3), orientation: take(4) })),
      traces: list(layout.traces.length, (k) => ({ points: take(3), about: layout.traces[k] ? take(3) : null })),
      arrows: list(layout.arrows, () => ({ start: take(3), vector: take(3) })),
      curves: list(layout.curves, () => ({ values: take(1) })),
    };
  }

  // The word for the end of a run until the answer, and what the whole run has done after that: a top may fall back.
  function wordsOf([status, found]) {
    const after = Number.isFinite(found) && facts.afterwards.length ? facts.afterwards[moves.read("outcome", values)[0]] : "";
    return [wordFor(words[status] || "illegal", facts.answer.horizon), after].filter(Boolean);
  }
  function tell(outcome, run, took) {
    const found = outcome[1], word = wordsOf(outcome).join(", but ");
    result.replaceChildren();
    element("span", result, { textContent: facts.answer.label });
    element("strong", result, { textContent: Number.isFinite(found) ? `${digits(found)} ${facts.answer.unit}` : word });
    element("span", result, { className: "word", textContent: Number.isFinite(found) ? word : "\u00a0" });
    const list = element("dl", result), entry = (kind, ...texts) => element(kind, list).append(...texts);
    for (const curve of facts.summaries) {
      const { name, unit, factor } = curves[curve];
      const all = run.curves[curve].values.map((value) => factor * value), [begin, end] = [all[0], all[all.length - 1]];
      const drift = Math.max(...all.map((one) => Math.abs(one - begin))) / Math.abs(begin);
      entry("dt", name);
      if (drift < 1e-5) { entry("dd", `${digits(begin)} ${unit}`); entry("dt"); entry("dd", `constant to ${drift.toExponential(0)}`); continue; }
      const [from, to] = [`${digits(begin)} →`, `${digits(end)} ${unit}`].map((textContent) => Object.assign(document.createElement("span"), { textContent }));
      entry("dd", from, " ", to);
    }
    median = [...median, took].slice(-51);
    const middle = [...median].sort((a, b) => a - b)[median.length >> 1];
    document.getElementById("timing").textContent = `Integrated in your browser in ${middle.toFixed(1)} ms, with the equations and the method of the tables.`;
  }

  // Simulate the run of the sliders, with at most `most` frames; there are fewer while a slider moves.
  function simulate(most) {
    const began = performance.now();
    if (!allowed(values, [])[0]) {
      result.innerHTML = "<strong>not possible</strong><span>These values do not fit together: there is no such top or arena.</span>";
      return;
    }
    asks.run(values);
    const outcome = asks.read("outcome", values), took = performance.now() - began;
    const run = recorded(most), [first, ...rest] = wordsOf(outcome);
    const marked = [`${first === "inverted" ? "turned over" : first} at ${digits(outcome[1], 3)} s`, ...rest].join(", ");
    // The answer may be another quantity than a time.
    run.marks = facts.answer.unit === "s" && Number.isFinite(outcome[1]) ? [[outcome[1], marked]] : [];
    tell(outcome, run, took);
    if (player) player.setRun(0, 0, run);
    live.outcome = { status: words[outcome[0]], value: outcome[1], end: run.times[run.times.length - 1] };
  }

  let soon = 0, later = 0;
  function set(wanted, source = null) {
    values = wanted.map((value, k) => Math.min(sliders[k].high, Math.max(sliders[k].low, value)));
    knobs.forEach(({ input, shown }, k) => {
      const { low, high } = sliders[k];
      if (input !== source) input.value = (1000 * (values[k] - low)) / (high - low);
      shown.textContent = withUnit(values[k], sliders[k]);
      input.setAttribute("aria-valuetext", shown.textContent);
    });
    map.update(values);
    clearTimeout(later);
    // A browser does not draw a hidden page: without this, its few frames would replace the many when it is shown.
    later = setTimeout(() => { cancelAnimationFrame(soon); soon = 0; simulate(3000); remember(); }, 150);
    soon ||= requestAnimationFrame(() => { soon = 0; simulate(400); });
  }

  // Write the slider values into the page's address, so that a copied link opens the same run.
  const short = (value) => String(Number(value.toPrecision(8)));
  function remember() {
    const address = values.every((value, k) => value === initial[k]) ? "" : new URLSearchParams(sliders.map((slider, k) => [slider.name, short(values[k])]));
    // The address of a page inside another page may not be changeable.
    try { history.replaceState(null, "", `#${address}`); } catch (error) { /* The run then has no link. */ }
  }
  // The end of a parameter's name is enough if only one slider's ends so.
  function fromAddress() {
    const wanted = [...initial];
    for (const [name, text] of new URLSearchParams(location.hash.slice(1))) {
      const alike = sliders.filter(({ path }) => `.${path}`.endsWith(`.${name}`));
      const slider = sliders.find((one) => one.name === name) || (alike.length === 1 && alike[0]);
      if (slider && text && Number.isFinite(Number(text))) wanted[sliders.indexOf(slider)] = Number(text);
    }
    return wanted;
  }

  const map = makeMap(document.getElementById("map"), window.live, integrator, (wanted) => set(wanted));
  const reset = () => set([...initial]);
  document.getElementById("reset").addEventListener("click", reset);
  document.addEventListener("keydown", (event) => {
    // A menu and a field take letters themselves.
    if (event.target.matches?.("select, textarea, input:not([type=range])")) return;
    if (event.key === "r" && !event.ctrlKey && !event.metaKey && !event.altKey) reset();
  });
  window.addEventListener("hashchange", () => set(fromAddress()));
  Object.assign(live, { curves, set, map, values: () => values, simulate, asks, moves, player: () => player });
  set(fromAddress());
  if (window.views) {
    player = await window.views.ready;
    simulate(3000);
  }
  live.ready = true;
})();
