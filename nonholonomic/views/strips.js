// Strips of curves over time, one for each label, with the curves of all runs in it.
"use strict";
window.views = window.views || {};
(() => {
  const digits = (v, count = 4) =>
    v === 0 ? "0" : Math.abs(v) < 1e-3 || Math.abs(v) >= 1e5 ? v.toExponential(2) : Math.abs(v) >= 10 ** count ? String(Math.round(v)) : v.toPrecision(count);

  // The place of a time among the times of a run: the index before it, and the fraction of the interval after that index.
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

  // The value at a place, interpolated linearly like bodies and arrows; beside a gap, the nearer value.
  function valueAt(values, [k, part]) {
    const before = values[k], after = values[Math.min(k + 1, values.length - 1)], v = (1 - part) * before + part * after;
    return Number.isFinite(v) ? v : part < 0.5 ? before : after;
  }

  //: Room left of a curve for its numbers, and below it for those of the time; the length of a tick; the sizes of the texts in pixels.
  const LEFT = 66, FOOT = 24, TICK = 4, TEXT = 13;
  //: Least distance of the numbers of the time in pixels.
  const APART = 64;

  // The least round step that is not below `least`.
  function rounded(least, isAngle) {
    const power = 10 ** Math.floor(Math.log10(least));
    const steps = isAngle && least > 10 && least <= 180 ? [15, 30, 45, 90, 180] : [1, 2, 5, 10].map((one) => one * power);
    return steps.find((one) => one >= 0.999 * least);
  }
  // The numbers at the multiples of a step, and their texts.
  function numbered(low, high, step) {
    const begin = Math.ceil(low / step - 1e-6), count = Math.floor(high / step + 1e-6) - begin + 1, most = Math.max(Math.abs(low), Math.abs(high));
    const text = (v) => v === 0 ? "0" : most < 1e-3 || most >= 1e5 ? Number(v.toPrecision(6)).toExponential()
      : v.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
    return Array.from({ length: count }, (_, k) => step * (begin + k)).map((v) => [v, text(v)]);
  }
  // The numbers at an axis: round ones, at least two; and its ends, moved to such a number if one is near.
  function ticked(low, high, isAngle) {
    const least = (high - low) / 4, step = rounded(least, isAngle);
    const [first, last] = [Math.floor, Math.ceil].map((round, k) => step * round([low, high][k] / step));
    [low, high] = [low - first < least ? first : low, last - high < least ? last : high];
    return { low, high, ticks: numbered(low, high, step) };
  }

  //: Dashes and gaps in pixels of the curves of runs whose colour is also that of an earlier run.
  const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3]];
  // The run's dashes: none for the first run of a colour.
  function dashesOf(runs, number) {
    return DASHES[runs.slice(0, number).filter(({ colour }) => colour === runs[number].colour).length % DASHES.length];
  }
  // A piece of the curve of a run, for legends.
  function sample(parent, { colour, dashes }) {
    const end = { width: 30, height: 4 }, canvas = views.element("canvas", parent, { className: "sample", ...end }), pen = canvas.getContext("2d");
    canvas.setAttribute("aria-hidden", "true");
    Object.assign(pen, { strokeStyle: colour, lineWidth: 4 });
    pen.setLineDash(dashes ?? []); pen.beginPath(); pen.moveTo(0, 2); pen.lineTo(30, 2); pen.stroke();
  }

  const labelOf = ({ name, unit }) => (unit ? `${name} [${unit}]` : name);

  class Strips {
    // `runs()`: returns the runs, with `times`, `colour` and `curves`; `seek(time)`: called when the reader clicks at a time.
    constructor(parent, runs, seek) {
      Object.assign(this, { runs, seek, now: 0, pointed: null });
      if (runs().length > 1) {
        const legend = views.element("div", parent, { className: "names" });
        for (const run of runs()) {
          const name = views.element("span", legend);
          name.style.color = run.colour;
          sample(name, run);
          name.append(run.legend ?? run.name);
        }
      }
      const curves = runs().flatMap((run) => run.curves), labels = [...new Set(curves.map(labelOf))];
      // The curves that check a run are folded away below the others.
      const folded = (label) => labels.length > 2 && /^(energy|Jellett)/.test(label);
      let fold = null;
      const more = () => {
        const details = views.element("details", parent, { className: "more" });
        views.element("summary", details, { textContent: "More curves" });
        return views.element("div", details, { className: "strips" });
      };
      this.strips = labels.sort((a, b) => folded(a) - folded(b)).map((label, k) => {
        if (folded(label)) fold = fold || more();
        const box = views.element("div", fold || parent, { className: "strip" }), head = views.element("div", box, { className: "head" });
        views.element("span", head, { textContent: label });
        const value = views.element("span", head, { className: "value" }), canvas = views.element("canvas", box);
        canvas.setAttribute("role", "img");
        canvas.setAttribute("aria-label", `curve of ${label} over time; a click sets the time`);
        // Below the first curve, where they cover none.
        const told = k === 0 ? views.element("div", box, { className: "told" }) : null;
        const strip = { label, canvas, value, told };
        const at = (event) => {
          const edge = canvas.getBoundingClientRect(), part = (event.clientX - edge.left - LEFT) / (edge.width - LEFT - 4);
          return Math.min(Math.max(part, 0), 1) * this.duration;
        };
        canvas.addEventListener("pointermove", (event) => {
          if (event.buttons) seek(at(event)); else { this.pointed = at(event); this.draw(this.now); }
        });
        canvas.addEventListener("pointerleave", () => { this.pointed = null; this.draw(this.now); });
        canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); this.pointed = null; seek(at(event)); });
        return strip;
      });
      this.refresh();
      new ResizeObserver(() => { this.strips.forEach((strip) => { strip.ahead = null; }); this.draw(this.now); }).observe(parent);
    }
    // Read the runs again after their values or times have changed.
    refresh() {
      const runs = this.runs();
      this.duration = Math.max(...runs.map((run) => run.times[run.times.length - 1]));
      for (const strip of this.strips) {
        strip.curves = runs.flatMap((run) => run.curves.filter((curve) => labelOf(curve) === strip.label)
          .map((curve) => ({
            times: run.times, colour: run.colour, dashes: run.dashes ?? [], marks: run.marks, values: curve.factor === 1 ? curve.values : curve.values.map((v) => curve.factor * v),
          })));
        let low = Infinity, high = -Infinity;
        for (const curve of strip.curves) for (const v of curve.values) if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); }
        // Draw values that are constant except for round-off as a constant.
        const least = 1e-3 * Math.max(Math.abs(low), Math.abs(high)) || 1;
        if (!(high - low > least)) { low -= least; high += least; }
        // What is no pixel away from 0 is 0, such as the round-off of a body at the ground.
        const settled = (end) => Math.abs(end) < 1e-3 * (high - low) ? 0 : end;
        Object.assign(strip, ticked(settled(low), settled(high), strip.label.endsWith("[deg]")), { ahead: null });
        strip.told?.replaceChildren(...strip.curves.flatMap(({ colour, marks }) => marks.map(([, textContent]) => {
          const words = Object.assign(document.createElement("span"), { textContent });
          words.style.color = colour;
          return words;
        })));
      }
    }
    // The numbers of the time below a curve of a width in pixels.
    times(width) { return numbered(0, this.duration, rounded(this.duration / Math.min(10, Math.max(2, width / APART)))); }
    paint(strip) {
      const { canvas } = strip, ratio = window.devicePixelRatio || 1;
      const width = Math.max(1, Math.round(canvas.clientWidth * ratio)), height = Math.max(1, Math.round(canvas.clientHeight * ratio));
      canvas.width = width; canvas.height = height;
      const [x0, x1, y0, y1] = [LEFT * ratio, width - 4 * ratio, height - FOOT * ratio, 6 * ratio];
      const x = (t) => x0 + (t / this.duration) * (x1 - x0);
      const y = (v) => y0 + ((v - strip.low) / (strip.high - strip.low)) * (y1 - y0);
      const drawn = (thick) => {
        const layer = Object.assign(document.createElement("canvas"), { width, height }), pen = layer.getContext("2d");
        Object.assign(pen, { lineWidth: thick * ratio, lineJoin: "round" });
        for (const curve of strip.curves) {
          pen.strokeStyle = curve.colour; pen.setLineDash(curve.dashes.map((length) => length * ratio)); pen.beginPath();
          let down = false;
          curve.values.forEach((v, k) => {
            if (!Number.isFinite(v)) { down = false; return; }
            if (down) pen.lineTo(x(curve.times[k]), y(v)); else pen.moveTo(x(curve.times[k]), y(v));
            down = true;
          });
          pen.stroke();
        }
        return layer;
      };
      Object.assign(strip, { x, y, x0, x1, y0, y1, ratio, times: this.times(canvas.clientWidth - LEFT), ahead: drawn(1.5), passed: drawn(2.8) });
    }
    draw(time) {
      this.now = time;
      for (const strip of this.strips) this.drawOne(strip, time);
    }
    drawOne(strip, time) {
      if (!strip.ahead) this.paint(strip);
      const { canvas, x0, x1, y0, y1, ratio } = strip, pen = canvas.getContext("2d"), now = strip.x(time);
      pen.clearRect(0, 0, canvas.width, canvas.height);
      Object.assign(pen, { fillStyle: "#23262b", font: `${TEXT * ratio}px system-ui, sans-serif`, textAlign: "right", textBaseline: "middle" });
      Object.assign(pen, { strokeStyle: "#dde1e6", lineWidth: ratio });
      pen.strokeRect(x0, y1, x1 - x0, y0 - y1);
      for (const [tick, text] of strip.ticks) {
        const at = strip.y(tick), half = 0.5 * TEXT * ratio;
        pen.beginPath(); pen.moveTo(x0, at); pen.lineTo(x1, at); pen.stroke();
        pen.fillText(text, x0 - 6 * ratio, Math.min(Math.max(at, half), canvas.height - half));
      }
      const below = y0 + (TICK + 4 + 0.5 * TEXT) * ratio;
      pen.fillText("time [s]", x0 - 10 * ratio, below);
      pen.strokeStyle = "#6b7280"; pen.textAlign = "center"; pen.beginPath();
      for (const [tick, text] of strip.times) {
        const at = strip.x(tick), half = 0.5 * pen.measureText(text).width;
        pen.moveTo(at, y0); pen.lineTo(at, y0 + TICK * ratio);
        pen.fillText(text, Math.min(at, canvas.width - half), below);
      }
      pen.stroke();
      pen.drawImage(strip.ahead, 0, 0);
      pen.save(); pen.beginPath(); pen.rect(0, 0, now, canvas.height); pen.clip(); pen.drawImage(strip.passed, 0, 0); pen.restore();
      const upright = (at, dashes, colour = "#23262b") => {
        pen.strokeStyle = colour; pen.setLineDash(dashes); pen.beginPath(); pen.moveTo(at, y0); pen.lineTo(at, y1); pen.stroke(); pen.setLineDash([]);
      };
      strip.curves.forEach(({ times, values, colour, marks }) => marks.forEach(([at]) => {
        upright(strip.x(at), [2 * ratio, 2 * ratio], colour);
        pen.fillStyle = colour; pen.beginPath(); pen.arc(strip.x(at), strip.y(valueAt(values, place(times, at))), 4 * ratio, 0, 7); pen.fill();
      }));
      upright(now, []);
      if (this.pointed !== null) upright(strip.x(this.pointed), [3 * ratio, 3 * ratio]);
      const shown = this.pointed ?? time;
      strip.value.textContent = this.pointed === null ? "" : `${shown.toFixed(3)} s: `;
      for (const { times, values, colour } of strip.curves) {
        const v = valueAt(values, place(times, shown));
        views.element("span", strip.value, { textContent: ` ${Number.isFinite(v) ? digits(v) : "-"}` }).style.color = colour;
        if (Number.isFinite(v) && shown <= times[times.length - 1] + 1e-9) {
          pen.fillStyle = colour; pen.beginPath(); pen.arc(strip.x(shown), strip.y(v), 3 * ratio, 0, 7); pen.fill();
        }
      }
    }
  }

  Object.assign(window.views, { Strips, place, digits, dashesOf, sample });
})();
