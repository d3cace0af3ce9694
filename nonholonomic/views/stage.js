// One stage: an arena and bodies in three dimensions, drawn by three.js. It knows poses, not times; player.js sets the poses.
"use strict";
window.views = window.views || {};
(() => {
  const { sqrt, cos, max, min, hypot } = Math;
  //: Faces are drawn as one smooth surface if the cosine of the angle between their normals is above this.
  const CREASE = cos(0.8);
  //: Least height of the camera above the tangent plane, divided by its distance, so that it cannot look from below.
  const LOWEST = 0.06;
  //: Opening angle of the camera in degrees, and the part of the width and of the height that a level rectangle with axes fills.
  const ANGLE = 35, FILLED = [0.7, 0.8];
  //: Colours behind the arena and of the lines on it.
  const BACKGROUND = "#fbfbfa", LINES = "#7c8896";
  const element = (kind, parent, properties = {}) => parent.appendChild(Object.assign(document.createElement(kind), properties));

  // The meshes of one body as corners with normals, averaged over the triangles around a corner except at sharp edges.
  function creased(meshes) {
    const faces = new Map(), parts = [];
    for (const { vertices, triangles } of meshes) {
      const count = triangles.length, positions = new Float32Array(3 * count), flat = new Float32Array(count), keys = [];
      for (let k = 0; k < count; k++) for (let c = 0; c < 3; c++) positions[3 * k + c] = vertices[3 * triangles[k] + c];
      for (let k = 0; k < count; k += 3) {
        const [a, b, c] = [0, 1, 2].map((j) => positions.subarray(3 * (k + j), 3 * (k + j) + 3));
        const [u, v] = [b, c].map((end) => [end[0] - a[0], end[1] - a[1], end[2] - a[2]]);
        const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        flat.set(normal, k);
        for (const corner of [a, b, c]) {
          const key = [...corner].map((x) => Math.round(x * 1e6)).join();
          keys.push(key);
          if (!faces.has(key)) faces.set(key, []);
          faces.get(key).push(normal);
        }
      }
      parts.push({ positions, flat, keys });
    }
    return parts.map(({ positions, flat, keys }) => {
      const normals = new Float32Array(positions.length);
      keys.forEach((key, k) => {
        const own = flat.subarray(k - (k % 3), k - (k % 3) + 3), size = hypot(...own) || 1, sum = [0, 0, 0];
        for (const other of faces.get(key)) {
          const along = own[0] * other[0] + own[1] * other[1] + own[2] * other[2];
          if (along >= CREASE * size * hypot(...other)) for (let c = 0; c < 3; c++) sum[c] += other[c];
        }
        const length = hypot(...sum) || 1;
        for (let c = 0; c < 3; c++) normals[3 * k + c] = sum[c] / length;
      });
      return { positions, normals };
    });
  }

  class Stage {
    // `fact`: the data of a stage from Python, with unpacked arrays; `box`: the element that the stage fills.
    constructor(THREE, box, fact) {
      Object.assign(this, { THREE, box, fact, size: max(...fact.shows.map((run) => run.size)), focus: null, span: 1 });
      this.renderer = this.drawer();
      this.renderer.setPixelRatio(min(window.devicePixelRatio || 1, 2));
      this.renderer.shadowMap.enabled = true;
      this.renderer.shadowMap.type = THREE.PCFSoftShadowMap;
      box.appendChild(this.renderer.domElement);
      this.labels = element("div", box, { className: "labels" });
      this.scene = new THREE.Scene();
      this.scene.background = new THREE.Color(BACKGROUND);
      this.camera = new THREE.PerspectiveCamera(ANGLE, 1, 0.01 * this.size, 1e4 * this.size);
      this.camera.up.set(0, 0, 1);
      this.controls = new THREE.OrbitControls(this.camera, this.renderer.domElement);
      this.controls.addEventListener("change", () => this.render());
      this.light();
      this.arena(fact.arena);
      this.runs = fact.shows.map((run) => this.run(run));
      this.fit();
      fact.camera = this.placed();
      this.reset();
      new ResizeObserver(() => { if (this.fit()) this.render(); }).observe(box);
    }

    // Without WebGL, a text stands in place of the picture; curves and sliders work.
    drawer() {
      try {
        const renderer = new this.THREE.WebGLRenderer({ antialias: true }), { title, shows } = this.fact;
        const words = [title, ...new Set(shows.map((run) => run.name))].filter(Boolean).join(", ") || document.title;
        renderer.domElement.setAttribute("role", "img");
        renderer.domElement.setAttribute("aria-label", `3D view: ${words}`);
        return renderer;
      } catch (error) {
        this.box.classList.add("flat");
        const words = `This picture needs WebGL, which the browser does not provide (${error.message.replace(/\.+$/, "")}). Open the page in another browser, or switch on hardware acceleration.`;
        const domElement = element("p", this.box, { className: "warning", textContent: words });
        return { domElement, shadowMap: {}, setPixelRatio() {}, setSize() {}, render() {} };
      }
    }
    light() {
      const { THREE, scene, size } = this;
      scene.add(new THREE.HemisphereLight(0xffffff, 0xc9cdd3, 0.6));
      this.sun = new THREE.DirectionalLight(0xffffff, 0.4);
      this.sun.castShadow = true;
      this.sun.shadow.mapSize.set(2048, 2048);
      this.sun.shadow.radius = 3;
      this.sun.shadow.bias = -2e-3;
      scene.add(this.sun, this.sun.target);
      this.shadowOver(3.5 * size);
    }
    shadowOver(reach) {
      const view = this.sun.shadow.camera;
      Object.assign(view, { left: -reach, right: reach, top: reach, bottom: -reach, near: 0.1 * reach, far: 12 * reach });
      view.updateProjectionMatrix();
      this.reach = reach;
    }

    geometry({ positions, normals }) {
      const { THREE } = this, geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
      if (normals) geometry.setAttribute("normal", new THREE.BufferAttribute(normals, 3));
      return geometry;
    }
    // Draw only the front of the surface, so that a wall between camera and body hides nothing.
    arena({ mesh: { vertices, triangles, colour }, lines, axes }) {
      const { THREE } = this, geometry = this.geometry({ positions: vertices });
      geometry.setIndex(new THREE.BufferAttribute(triangles, 1));
      geometry.computeVertexNormals();
      const ground = new THREE.Mesh(geometry, new THREE.MeshPhongMaterial({ color: colour, specular: 0, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 }));
      ground.receiveShadow = true;
      this.scene.add(ground);
      const pairs = [];
      for (const line of [...lines, ...this.axes(axes, vertices)]) for (let k = 0; k + 5 < line.length; k += 3) pairs.push(...line.subarray(k, k + 6));
      const grid = this.geometry({ positions: new Float32Array(pairs) });
      this.scene.add(new THREE.LineSegments(grid, new THREE.LineBasicMaterial({ color: LINES, transparent: true, opacity: 0.55 })));
    }

    // Lines at round values over a level rectangle, with labels along two of its sides, between which the names stand.
    axes(axes, vertices) {
      const [low, high] = [vertices.subarray(0, 3), vertices.subarray(9, 12)], lines = [];
      const gap = 0.05 * max(high[0] - low[0], high[1] - low[1]);
      this.marks = [];
      axes.forEach(([name, centre, scale], k) => {
        const [begin, end] = [low[k], high[k]].map((place) => centre + place / scale), span = end - begin;
        // The labels of a narrow side need room, too.
        const least = max(span / 50, min(span / 7, (0.6 * this.size) / scale), (1.6 * gap) / scale);
        const power = 10 ** Math.floor(Math.log10(least)), step = power * [1, 2, 5, 10].find((factor) => factor * power >= 0.999 * least);
        const point = (along, across) => (k ? [across, along, low[2]] : [along, across, low[2]]);
        const mark = (textContent, along, away) => this.marks.push({
          label: element("span", this.labels, { className: "mark", textContent }),
          at: new this.THREE.Vector3(...point(along, low[1 - k])),
          beyond: new this.THREE.Vector3(...point(along, low[1 - k] - gap)),
          axis: k,
          isName: away > 1,
        });
        const first = Math.ceil(begin / step - 1e-9), count = Math.floor(end / step + 1e-9) - first + 1;
        for (let n = first; n < first + count; n++) {
          const along = (n * step - centre) * scale;
          lines.push(Float32Array.from([...point(along, low[1 - k]), ...point(along, high[1 - k])]));
          if (count <= 12) mark(String(Number((n * step).toPrecision(6))), along, 1);
        }
        mark(name, (low[k] + high[k]) / 2, 2);
      });
      return lines;
    }
    run(fact) {
      const bodies = fact.bodies.map((body) => this.body(body.meshes));
      // Traces of several runs have the colours of the runs.
      const traces = fact.traces.map((trace) => this.trace(this.fact.shows.length > 1 ? { ...trace, colour: fact.colour } : trace));
      const arrows = fact.arrows.map((arrow) => this.arrow(arrow, this.fact.shows.length > 1 ? fact.colour : arrow.colour));
      const name = this.fact.shows.length > 1 ? element("span", this.labels, { className: "name", textContent: fact.name }) : null;
      if (name) name.style.background = fact.colour;
      return { bodies, traces, arrows, name, normal: [0, 0, 1] };
    }
    body(meshes) {
      const { THREE, scene } = this, group = new THREE.Group();
      creased(meshes).forEach((part, k) => {
        const material = new THREE.MeshPhongMaterial({ color: meshes[k].colour, specular: 0x2a2a2a, shininess: 35, side: THREE.DoubleSide });
        const mesh = new THREE.Mesh(this.geometry(part), material);
        mesh.castShadow = true;
        group.add(mesh);
      });
      scene.add(group);
      return group;
    }
    trace({ colour, width, points, shown }) {
      const { THREE, scene, size } = this;
      const material = new THREE.LineMaterial({ color: new THREE.Color(colour).getHex(), linewidth: max(1.2, min(3, (45 * width) / size)) });
      const line = new THREE.Line2(new THREE.LineGeometry(), material);
      line.frustumCulled = false;
      scene.add(line);
      const drawn = { line, shown };
      this.setPoints(drawn, points);
      return drawn;
    }
    setPoints(trace, points) {
      trace.line.geometry.dispose();
      trace.line.geometry = new this.THREE.LineGeometry();
      trace.line.geometry.setPositions(points.length > 3 ? points : [...points, ...points]);
    }
    // A shaft of length one, which is scaled, and a tip; an arrow that is visible through the body has a ball at its start.
    // A line has no unit, and no tip.
    arrow({ colour, width, through, unit, factor, scale, limit, shown }, shade) {
      const { THREE, scene } = this, group = new THREE.Group(), head = unit ? 5 * width : 0;
      const material = new THREE.MeshPhongMaterial({ color: colour, specular: 0, depthTest: !through, transparent: through });
      const part = (geometry) => {
        const mesh = new THREE.Mesh(geometry, material);
        mesh.renderOrder = through ? 2 : 0;
        mesh.castShadow = !unit;
        group.add(mesh);
        return mesh;
      };
      const shaft = part(new THREE.CylinderGeometry(width, width, 1, 20).translate(0, 0.5, 0));
      const tip = part(new THREE.ConeGeometry(2.4 * width, head, 24).translate(0, head / 2, 0));
      if (through) part(new THREE.SphereGeometry(1.8 * width, 20, 14));
      scene.add(group);
      const label = element("span", this.labels, { className: "force" });
      // In the colour of the arrow, or of the run if there are several; dark enough to be read on the ground.
      label.style.color = new THREE.Color(shade).multiplyScalar(0.5).getStyle();
      return { group, shaft, tip, head, unit, factor, scale, limit: limit ?? Infinity, label, shown, size: 0, shownSize: 0 };
    }

    // Setters, for the player or a live simulation.
    setPose(run, body, position, quaternion) {
      const group = this.runs[run].bodies[body];
      group.position.set(...position);
      group.quaternion.set(...quaternion);
    }
    setTrace(run, trace, count, about) {
      const { line, shown } = this.runs[run].traces[trace];
      line.geometry.instanceCount = max(0, count);
      line.visible = shown && count > 0;
      if (about) line.position.set(...about);
    }
    setArrow(run, number, start, vector) {
      const arrow = this.runs[run].arrows[number], { group, shaft, tip } = arrow;
      arrow.size = hypot(...vector);
      // Round-off, whose arrow nobody sees, is 0.
      arrow.shownSize = arrow.size * arrow.scale < 1e-9 * this.size ? 0 : arrow.factor * arrow.size;
      const length = min(arrow.size * arrow.scale, arrow.limit), head = min(arrow.head, 0.6 * length);
      group.visible = arrow.shown && length > 0.02 * arrow.head;
      if (!group.visible) return;
      group.position.set(...start);
      group.quaternion.setFromUnitVectors(new this.THREE.Vector3(0, 1, 0), new this.THREE.Vector3(...vector).normalize());
      shaft.scale.set(1, max(length - head, 1e-9), 1);
      tip.position.set(0, length - head, 0);
      tip.scale.setScalar(max(head / (arrow.head || 1), 1e-9));
      arrow.length = length;
    }
    setNormal(run, normal) { this.runs[run].normal = normal; }
    // Show or hide an item of all runs; `kind` is "arrows" or "traces".
    show(kind, number, shown) { for (const run of this.runs) run[kind][number].shown = shown; }

    // Point the camera at the bodies; a camera that follows keeps its position relative to them.
    look(points, follow) {
      const focus = [0, 1, 2].map((c) => points.reduce((sum, point) => sum + point[c], 0) / points.length);
      const apart = max(...points.map((point) => hypot(...point.map((x, c) => x - focus[c]))));
      // Bodies that part need more distance in a picture that is not wider than it is high.
      const span = 3.6 * this.size + (this.camera.aspect < 1.3 ? 1.3 : 1) * apart, { camera, controls } = this;
      if (this.focus && follow) {
        ["x", "y", "z"].forEach((axis, c) => {
          const away = ((camera.position[axis] - controls.target[axis]) * span) / this.span;
          controls.target[axis] += focus[c] - this.focus[c];
          camera.position[axis] = controls.target[axis] + away;
        });
      }
      [this.focus, this.span] = [focus, span];
      const wanted = apart + 3.5 * this.size;
      if (wanted > 1.2 * this.reach || wanted < 0.6 * this.reach) this.shadowOver(wanted);
      const near = this.runs.map((run) => run.bodies[0].position).every((place, k, all) => place.distanceTo(all[0]) < this.size);
      this.runs.forEach(({ bodies }, k) => bodies.forEach((group) => group.children.forEach(({ material }) => {
        // To distinguish bodies at the same place, make all but the first transparent.
        Object.assign(material, { transparent: k > 0 && near, opacity: k > 0 && near ? 0.5 : 1 });
      })));
    }
    // The first place and target of the camera. It follows bodies that are small compared with their paths. Otherwise a level
    // rectangle with axes, and all that is drawn above it, fill the picture, but for the room of the labels.
    placed() {
      const { THREE: { Box3, Vector3 }, fact: { arena, shows, follows, rise }, size } = this, { fov, aspect } = this.camera;
      const points = (values) => {
        const list = [];
        for (let k = 0; k + 2 < values.length; k += 3) if (Number.isFinite(values[k] + values[k + 1] + values[k + 2])) list.push(new Vector3().fromArray(values, k));
        return list;
      };
      const centred = (list) => { const middle = new Box3().setFromPoints(list).getCenter(new Vector3()); return [middle, list.reduce((far, p) => max(far, p.distanceTo(middle)), 0)]; };
      const paths = shows.map(({ bodies }) => points(bodies[0].position)), normal = new Vector3(...arena.normal), aside = new Vector3(0.35, -1, 0);
      let [middle, reach] = centred(paths.flat());
      this.fact.follow = follows || reach > 4 * size;
      if (this.fact.follow) {
        [middle, reach] = centred(paths.map(([start]) => start));
        reach += 1.1 * size;
      }
      const back = aside.addScaledVector(normal, -aside.dot(normal)).normalize().addScaledVector(normal, rise).normalize();
      let distance = (1.05 * (reach + 1.6 * size)) / Math.sin((ANGLE * Math.PI) / 360);
      if (arena.axes.length && !this.fact.follow) {
        const farthest = (meshes) => max(0, ...meshes.map(({ vertices }) => points(vertices).reduce((far, p) => max(far, p.length()), 0)));
        const drawn = points(arena.mesh.vertices);
        for (const { bodies, arrows } of shows) {
          for (const { position, meshes } of bodies) { const height = farthest(meshes); for (const p of points(position)) drawn.push(p.setZ(p.z + height)); }
          for (const { start, vector } of arrows) drawn.push(...points(start.map((x, k) => x + vector[k])));
        }
        [middle] = centred(drawn);
        const right = new Vector3().crossVectors(normal, back).normalize(), up = back.clone().cross(right), half = Math.tan((fov * Math.PI) / 360);
        distance = 0;
        for (const p of drawn) {
          p.sub(middle);
          distance = max(distance, p.dot(back) + max(Math.abs(p.dot(up)) / FILLED[1], Math.abs(p.dot(right)) / (FILLED[0] * aspect)) / half);
        }
      }
      return [middle.clone().addScaledVector(back, distance).toArray(), middle.toArray()];
    }
    reset() {
      const [place, target] = this.fact.camera;
      this.camera.position.set(...place);
      this.controls.target.set(...target);
      if (this.focus) this.recentre();
      this.controls.update();
    }
    // Return to the direction and distance of the first view, about the present place of the bodies.
    recentre() {
      const [place, target] = this.fact.camera;
      if (!this.fact.follow) return;
      const scale = this.span / this.firstSpan;
      this.controls.target.set(...this.focus);
      this.camera.position.set(...this.focus.map((x, c) => x + (place[c] - target[c]) * scale));
    }
    fromAbove() {
      const { camera, controls } = this, distance = camera.position.distanceTo(controls.target), normal = this.runs[0].normal;
      // Not exactly along `up`, where the rotation of the camera is undetermined.
      const tilted = new this.THREE.Vector3(...normal).add(new this.THREE.Vector3(0, -0.02, 0)).normalize();
      camera.position.copy(controls.target).addScaledVector(tilted, distance);
      controls.update();
      this.render();
    }

    // Fit the picture to its box. Lines need the number of pixels; without it, each line is as wide as the picture.
    fit() {
      const { clientWidth: width, clientHeight: height } = this.box;
      if (!width || !height) return false;
      this.renderer.setSize(width, height);
      for (const { traces } of this.runs) for (const { line } of traces) line.material.resolution.set(width, height);
      this.camera.aspect = width / height;
      // A narrow picture shows as much horizontally as a square picture shows vertically.
      this.camera.fov = 2 * Math.atan(Math.tan((ANGLE * Math.PI) / 360) / min(1, this.camera.aspect)) * 180 / Math.PI;
      this.camera.updateProjectionMatrix();
      return true;
    }
    // Keep the camera above the floor below the first body.
    aboveTheFloor() {
      if (!this.focus) return;
      const { camera, controls } = this, normal = new this.THREE.Vector3(...this.runs[0].normal);
      const away = camera.position.clone().sub(controls.target), distance = away.length();
      const height = away.dot(normal) + this.size, least = LOWEST * distance;
      if (height < least) camera.position.addScaledVector(normal, least - height);
      camera.lookAt(controls.target);
    }
    render() {
      const { camera, scene, sun, focus } = this;
      if (!this.box.clientWidth || !this.box.clientHeight) return;
      this.aboveTheFloor();
      const distance = camera.position.distanceTo(this.controls.target);
      Object.assign(camera, { near: 0.02 * distance, far: 20 * distance + 200 * this.size });
      camera.updateProjectionMatrix();
      if (focus) {
        const normal = this.runs[0].normal, aside = [-0.35, -0.22, 0.25];
        sun.target.position.set(...focus);
        sun.position.set(...focus.map((x, c) => x + 5 * this.reach * (normal[c] + aside[c])));
      }
      this.renderer.render(scene, camera);
      this.write();
    }
    // Write the names of bodies, and the sizes of forces in newtons, at their places on the screen.
    write() {
      const { camera, box, THREE } = this, width = box.clientWidth, height = box.clientHeight;
      const onScreen = (point) => {
        const at = point.clone().project(camera);
        return [((at.x + 1) / 2) * width, ((1 - at.y) / 2) * height, at.z < 1 && Math.abs(at.x) < 1 && Math.abs(at.y) < 1];
      };
      // Labels of an axis stand outside of it, wherever the camera is, and its name beyond the widest of them.
      const widest = [0, 0];
      for (const mark of this.marks) {
        mark.label.style.display = "";
        mark.sizes = mark.sizes?.[0] ? mark.sizes : [mark.label.offsetWidth, mark.label.offsetHeight];
        if (!mark.isName) widest[mark.axis] = max(widest[mark.axis], mark.sizes[0]);
      }
      for (const { label, at, beyond, axis, isName, sizes: [wide, high] } of this.marks) {
        const [x, y, seen] = onScreen(at), [toX, toY] = onScreen(beyond), far = hypot(toX - x, toY - y) || 1, [u, v] = [(toX - x) / far, (toY - y) / far];
        const away = 5 + (Math.abs(u) * wide + Math.abs(v) * high) / 2 + (isName ? Math.abs(u) * widest[axis] + Math.abs(v) * high : 0);
        label.style.display = seen ? "" : "none";
        label.style.transform = `translate(${(x + u * away).toFixed(1)}px, ${(y + v * away).toFixed(1)}px) translate(-50%, -50%)`;
      }
      const taken = [];
      // A label that would overlap another one moves up.
      const put = (label, [at, below, seen], lift) => {
        label.style.display = seen ? "" : "none";
        if (!seen) return;
        const wide = 7 * label.textContent.length + 12;
        // Nor does it leave the picture.
        const x = max(0, min(at, width - wide));
        let y = below - lift;
        for (const other of taken.sort((a, b) => b.y - a.y)) {
          if (x < other.x + other.wide && other.x < x + wide && Math.abs(y - other.y) < 19) y = other.y - 19;
        }
        taken.push({ x, y, wide });
        label.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
      };
      this.runs.forEach((run, k) => {
        if (run.name) {
          const over = new THREE.Vector3(...run.normal).multiplyScalar(1.7 * this.size).add(run.bodies[0].position);
          put(run.name, onScreen(over), 18);
        }
        for (const arrow of run.arrows) {
          if (arrow.unit !== "N" || !arrow.group.visible) { arrow.label.style.display = "none"; continue; }
          const end = new THREE.Vector3(0, arrow.length, 0).applyQuaternion(arrow.group.quaternion).add(arrow.group.position);
          arrow.label.textContent = `${views.digits(arrow.shownSize, 3)} N`;
          put(arrow.label, onScreen(end), 14);
        }
      });
    }
    // The matrix of a body in the scene, column by column.
    matrix(run, body) {
      const group = this.runs[run].bodies[body];
      group.updateMatrixWorld(true);
      return [...group.matrixWorld.elements];
    }
  }

  Object.assign(window.views, { Stage, element });
})();
