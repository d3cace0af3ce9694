// The player: unpacks the data from Python, sets the poses at a time, and contains the controls of time and camera.
"use strict";
window.views = window.views || {};
(() => {
  const text = (id) => document.getElementById(id).textContent;
  const bytes = (coded) => Uint8Array.from(atob(coded), (letter) => letter.charCodeAt(0));
  const inflated = (coded) => new Response(new Blob([bytes(coded)]).stream().pipeThrough(new DecompressionStream("deflate")));

  // Floats are stored byte plane by byte plane, and whole numbers as differences, because both then compress better.
  async function arrays() {
    const planes = new Uint8Array(await (await inflated(text("floats"))).arrayBuffer()), count = planes.length / 4;
    const joined = new Uint8Array(planes.length);
    for (let byte = 0; byte < 4; byte++) for (let k = 0; k < count; k++) joined[4 * k + byte] = planes[byte * count + k];
    const floats = new Float32Array(joined.buffer), steps = new Int32Array(await (await inflated(text("whole"))).arrayBuffer());
    return {
      floats: ([begin, length]) => floats.subarray(begin, begin + length),
      whole: ([begin, length]) => { let sum = 0; return Uint32Array.from(steps.subarray(begin, begin + length), (step) => (sum += step)); },
    };
  }
  async function library() {
    const exports = {};
    new Function("exports", "module", await (await inflated(text("library"))).text())(exports, {});
    return exports;
  }
  // A part of the facts with its arrays in place of what identifies them.
  function unpacked(part, arrays) {
    if (part === null || typeof part !== "object") return part;
    if (Array.isArray(part)) return part.map((one) => unpacked(one, arrays));
    if (part.floats) return arrays.floats(part.floats);
    if (part.whole) return arrays.whole(part.whole);
    return Object.fromEntries(Object.entries(part).map(([name, one]) => [name, unpacked(one, arrays)]));
  }

  const point = (values, [k, part]) =>
    [0, 1, 2].map((c) => (values.length > 3 ? (1 - part) * values[3 * k + c] + part * values[3 * k + 3 + c] : values[c]));
  function orientation(values, [k, part]) {
    const a = values.subarray(4 * k, 4 * k + 4), b = values.length > 4 ? values.subarray(4 * k + 4, 4 * k + 8) : a;
    let cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
    const sign = cosine < 0 ? -1 : 1;
    cosine = Math.min(1, Math.abs(cosine));
    const angle = Math.acos(cosine), sine = Math.sin(angle);
    const [p, q] = sine < 1e-4 ? [1 - part, part] : [Math.sin((1 - part) * angle) / sine, Math.sin(part * angle) / sine];
    const mixed = [0, 1, 2, 3].map((c) => p * a[c] + sign * q * b[c]), length = Math.hypot(...mixed);
    return mixed.map((c) => c / length);
  }

  class Player {
    constructor(root, facts, stages, THREE) {
      Object.assign(this, { facts, root, listeners: [], now: 0, running: false, before: null, turn: false, filming: false });
      const { element } = views, boxes = element("div", root, { id: "stages" });
      // The legend of the curves tells runs of equal names on several stages apart.
      const runs = stages.flatMap((fact) => fact.shows), names = runs.map((run) => run.name), once = (name) => names.indexOf(name) === names.lastIndexOf(name);
      for (const { title, shows } of stages) for (const run of shows) run.legend = once(run.name) ? run.name : `${title}, ${run.name}`;
      runs.forEach((run, k) => { run.dashes = views.dashesOf(runs, k); });
      this.stages = stages.map((fact) => this.figure(element("figure", boxes), fact, THREE));
      this.bar(element("div", root, { id: "controls" }));
      const strips = element("div", root, { id: "strips" });
      this.strips = new views.Strips(strips, () => this.runs(), (time) => { this.play(false); this.seek(time); });
      // What a picture or a film shows.
      this.parts = [boxes, strips];
      this.measure();
      this.keys();
      this.seek(0);
      for (const stage of this.stages) stage.firstSpan = stage.span;
      this.seek(0);
    }
    runs() { return this.stages.flatMap((stage) => stage.fact.shows); }
    measure() {
      this.length = Math.max(...this.runs().map((run) => run.times[run.times.length - 1]));
      this.slider.max = this.length;
    }

    figure(figure, fact, THREE) {
      const { element } = views, box = element("div", figure, { className: "scene" }), caption = element("figcaption", figure);
      const stage = new views.Stage(THREE, box, fact), buttons = element("div", box, { className: "buttons" });
      const button = (words, title, act) => element("button", buttons, { textContent: words, title, type: "button", onclick: act });
      stage.follows = fact.follow;
      const follow = button("Follow", "the camera moves along with the body", () => toggle(follow, (stage.follows = !stage.follows)));
      const orbit = button("Orbit", "the camera goes round the body", () => { toggle(orbit, (stage.orbits = !stage.orbits)); this.spin(); });
      button("From above", "look down on the arena", () => stage.fromAbove());
      button("Reset", "the first view", () => { toggle(follow, (stage.follows = fact.follow)); toggle(orbit, (stage.orbits = false)); stage.reset(); stage.render(); });
      const toggle = (one, on) => one.setAttribute("aria-pressed", String(on));
      toggle(follow, stage.follows); toggle(orbit, false);
      // Of a single stage, the heading of the page may say it already.
      if (fact.title && fact.title !== document.title) element("b", caption, { textContent: fact.title });
      const notes = new Set(fact.shows.map((run) => run.note).filter(Boolean));
      for (const note of notes) element("span", caption, { className: "warning", textContent: note });
      if (fact.arena.spacing) element("span", caption, { className: "key", textContent: fact.arena.spacing });
      for (const run of fact.shows.length > 1 ? fact.shows : []) {
        const key = element("span", caption, { className: "key" });
        views.sample(key, run);
        key.append(run.name);
      }
      const chip = (kind, { name, colour, shown }, k) => {
        const one = element("button", caption, { className: "chip", type: "button", title: "show or hide" });
        element("i", one).style.background = colour;
        one.append(name);
        one.onclick = () => { const on = !stage.runs[0][kind][k].shown; stage.show(kind, k, on); toggle(one, on); this.seek(this.now); };
        toggle(one, shown);
        return element("span", one);
      };
      // Traces of several runs have the colours of the runs, which the caption explains beside the names of the runs.
      fact.shows[0].traces.forEach((trace, k) => chip("traces", fact.shows.length > 1 ? { ...trace, colour: "#6b7280" } : trace, k));
      stage.values = fact.shows[0].arrows.map((arrow, k) => (arrow.unit ? chip("arrows", arrow, k) : null));
      return stage;
    }

    bar(controls) {
      const { element } = views;
      this.button = element("button", controls, { id: "play", type: "button", title: "space", onclick: () => this.play(!this.running) });
      this.slider = element("input", controls, { id: "slider", type: "range", min: 0, max: 1, step: "any", value: 0, ariaLabel: "time" });
      this.slider.addEventListener("input", () => { this.play(false); this.seek(Number(this.slider.value)); });
      this.clock = element("span", controls, { id: "clock" });
      this.speeds = element("select", controls, { id: "speed", title: "speed" });
      for (const [words, factor] of this.facts.speeds) element("option", this.speeds, { textContent: words, value: factor, selected: factor === this.facts.speed });
      // These stay together on a narrow screen.
      const tools = element("span", controls, { id: "tools" });
      this.savers(tools);
      if (this.root.requestFullscreen) {
        element("button", tools, { id: "full", type: "button", textContent: "Full screen", title: "f", onclick: () => this.fullScreen() });
      }
      this.button.textContent = "▶ play";
    }
    // Buttons that save what the page shows: a picture of it, or a film from the time of the slider on.
    savers(tools) {
      const { element } = views, words = document.title.trim().replace(/[^\p{L}\p{N}]+/gu, "-").slice(0, 60) || "run";
      const save = (blob, name) => {
        const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: `${words}${name}` });
        link.click();
        setTimeout(() => URL.revokeObjectURL(link.href), 6e4);
      };
      const can = "VideoEncoder" in window;
      const film = element("button", tools, { id: "save-film", type: "button", innerHTML: "<span>Save </span>film", disabled: !can, title: can ? "record a video from here on" : "this browser cannot make videos" });
      element("button", tools, { id: "save-picture", type: "button", innerHTML: "<span>Save </span>picture", title: "a PNG file of this moment", onclick: () => {
        this.root.classList.add("filming");
        this.seek(this.now);
        // A page that plays is at another time when the file is ready.
        const canvas = views.blank(this), time = this.now.toFixed(3);
        views.paint(canvas, this, `${time} s`);
        this.root.classList.remove("filming");
        canvas.toBlob((blob) => save(blob, `-${time}s.png`));
      } });
      let form = null;
      film.setAttribute("aria-expanded", "false");
      film.onclick = () => {
        if (this.filming) { this.filming = false; return; }
        if (form) form.remove();
        form = form ? null : this.filmForm(film, save);
        film.setAttribute("aria-expanded", String(form !== null));
      };
    }
    // The form for the length and the speed of a film, which shows how much is done; `film` is the button that opened it.
    filmForm(film, save) {
      const { element } = views, form = Object.assign(document.createElement("form"), { id: "film", ariaLabel: "film" });
      this.parts[1].before(form);
      const field = (words, input) => { const label = element("label", form, { textContent: `${words} ` }); label.append(input); return input; };
      const seconds = field("length [s]", Object.assign(document.createElement("input"), { type: "number", min: 0.001, step: "any", required: true }));
      const speed = field("speed", this.speeds.cloneNode(true));
      speed.removeAttribute("id");
      speed.value = this.speeds.value;
      element("button", form, { textContent: "Record" });
      const told = element("output", form), start = () => (this.now < this.length ? this.now : 0);
      let chosen = false;
      const longest = () => { if (!chosen) seconds.value = Number(((this.length - start()) / Number(speed.value)).toFixed(3)); };
      seconds.oninput = () => { chosen = true; };
      speed.onchange = longest;
      longest();
      seconds.focus();
      seconds.select();
      form.onsubmit = async (event) => {
        event.preventDefault();
        if (this.filming) return;
        this.filming = true;
        film.textContent = "Stop";
        const tell = (share) => { told.value = `${Math.floor(100 * share)} %`; return this.filming; };
        try {
          const blob = await this.film({ from: start(), seconds: Number(seconds.value), speed: Number(speed.value) }, tell);
          if (this.filming) save(blob, ".webm");
          told.value = this.filming ? "saved" : "stopped";
        } catch (error) {
          told.value = String(error);
        }
        this.filming = false;
        film.innerHTML = "<span>Save </span>film";
      };
      return form;
    }
    // A film of a run at `times`, or `from` a time on at a speed for some seconds, but not beyond the end.
    film({ times = null, from = 0, seconds = Infinity, speed = 1, fps = 25 }, tell = () => true) {
      const step = speed / fps, end = Math.min(this.length, from + seconds * speed);
      const count = Math.ceil((end - from) / step - 1e-6) + 1;
      return views.record(this, times || Array.from({ length: count }, (_, k) => Math.min(from + k * step, end)), fps, tell);
    }
    fullScreen() { if (document.fullscreenElement) document.exitFullscreen(); else this.root.requestFullscreen(); }
    keys() {
      const acts = {
        Space: () => this.play(!this.running),
        ArrowRight: () => { this.play(false); this.seek(this.now + this.frame()); },
        ArrowLeft: () => { this.play(false); this.seek(this.now - this.frame()); },
        Home: () => this.seek(0),
        End: () => this.seek(this.length),
        KeyF: () => this.fullScreen(),
      };
      document.addEventListener("keydown", (event) => {
        const { target } = event, act = acts[event.code], own = target === this.slider;
        if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
        if (/^(INPUT|SELECT|TEXTAREA)$/.test(target.tagName) && !own) return;
        if (event.code === "Space" && /^(BUTTON|SUMMARY)$/.test(target.tagName)) return;
        event.preventDefault();
        act();
      });
    }
    // Time between two frames at the selected speed.
    frame() { return Number(this.speeds.value) / 25; }

    // Replace the displayed data of a run by arrays in the form that Python writes; omitted arrays do not change.
    setRun(s, r, run) {
      const stage = this.stages[s], fact = stage.fact.shows[r];
      const merged = (name) => run[name] && run[name].forEach((one, k) => Object.assign(fact[name][k], one));
      if (run.times) fact.times = run.times;
      if (run.normal) fact.normal = run.normal;
      if (run.marks) fact.marks = run.marks;
      ["bodies", "traces", "arrows", "curves"].forEach(merged);
      (run.traces || []).forEach((trace, k) => { if (trace.points) stage.setPoints(stage.runs[r].traces[k], trace.points); });
      this.measure();
      this.strips.refresh();
      this.seek(this.now);
    }
    show(stage, r, time) {
      const run = stage.fact.shows[r], at = views.place(run.times, time), count = at[0] + at[1];
      stage.setNormal(r, point(run.normal, at));
      run.bodies.forEach((body, k) => stage.setPose(r, k, point(body.position, at), orientation(body.orientation, at)));
      run.traces.forEach((trace, k) => stage.setTrace(r, k, Math.round(count), trace.about && point(trace.about, at)));
      run.arrows.forEach((arrow, k) => stage.setArrow(r, k, point(arrow.start, at), point(arrow.vector, at)));
      return point(run.bodies[0].position, at);
    }
    seek(wanted) {
      this.now = Math.min(Math.max(wanted, 0), this.length);
      for (const stage of this.stages) {
        stage.look(stage.fact.shows.map((_, r) => this.show(stage, r, this.now)), stage.follows);
        stage.render();
        stage.values.forEach((value, k) => {
          if (!value) return;
          // One number for each run, in the colour of the run if there are several.
          const sizes = stage.runs.map(({ arrows }) => ` ${views.digits(arrows[k].shownSize, 3)} ${arrows[k].unit}`);
          value.replaceChildren(...sizes.map((textContent) => Object.assign(document.createElement("span"), { textContent })));
          if (sizes.length > 1) stage.fact.shows.forEach(({ colour }, r) => { value.children[r].style.color = colour; });
        });
      }
      this.strips.draw(this.now);
      this.slider.value = this.now;
      this.clock.textContent = `${this.now.toFixed(3)} s of ${this.length.toFixed(2)} s`;
      for (const listener of this.listeners) listener(this.now);
    }
    play(wanted) {
      this.touched = true;
      if (wanted && this.now >= this.length) this.seek(0);
      this.running = wanted;
      this.button.textContent = wanted ? "❚❚ pause" : "▶ play";
      this.before = null;
      if (wanted) requestAnimationFrame((now) => this.step(now));
    }
    step(now) {
      if (!this.running) return;
      if (this.before !== null) this.seek(this.now + ((now - this.before) / 1000) * Number(this.speeds.value));
      this.before = now;
      if (this.now >= this.length) this.play(false); else requestAnimationFrame((next) => this.step(next));
    }
    // Turn the cameras that go round the bodies, as far as they go in so many sixtieths of a second.
    orbit(count) {
      const turned = this.stages.filter((stage) => stage.orbits);
      for (const stage of turned) {
        Object.assign(stage.controls, { autoRotate: true, autoRotateSpeed: 2 * count });
        stage.controls.update();
        stage.controls.autoRotate = false;
        stage.render();
      }
      return turned.length > 0;
    }
    spin() {
      if (this.turn) return;
      // A film turns the cameras itself.
      const round = () => { this.turn = this.filming || this.orbit(1); if (this.turn) requestAnimationFrame(round); };
      this.turn = true;
      requestAnimationFrame(round);
    }
    // Play once when the stages become visible, unless the reader's system requests reduced motion.
    autoplay() {
      if (matchMedia("(prefers-reduced-motion: reduce)").matches) return;
      const watch = new IntersectionObserver((entries) => {
        if (!entries.some((entry) => entry.isIntersecting)) return;
        watch.disconnect();
        if (!this.touched) this.play(true);
      }, { threshold: 0.3 });
      watch.observe(this.stages[0].box);
    }
  }

  views.ready = (async () => {
    const facts = JSON.parse(text("facts")), [unpack, THREE] = await Promise.all([arrays(), library()]);
    const root = document.getElementById("view");
    const player = new Player(root, facts, facts.stages.map((stage) => unpacked(stage, unpack)), THREE);
    if (facts.autoplay) player.autoplay();
    const handle = {
      seek: (time) => { player.touched = true; player.seek(time); },
      play: (wanted) => player.play(wanted),
      setRun: (s, r, run) => player.setRun(s, r, run),
      film: (wanted, tell) => player.film(wanted, tell),
      onSeek: (listener) => player.listeners.push(listener),
      time: () => player.now,
      playing: () => player.running,
      duration: () => player.length,
      stages: player.stages,
      matrix: (stage, run, body) => player.stages[stage].matrix(run, body),
    };
    window.player = handle;
    return handle;
  })();
})();
