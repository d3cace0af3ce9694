// Pictures and films of the page: stages and curves as they are on the screen, below a line with the time.
"use strict";
window.views = window.views || {};
(() => {
  //: Height of the line with the time, width of the margins, greatest width of a film in pixels, and most frames between two key frames.
  const HEAD = 28, MARGIN = 8, WIDEST = 1920, KEY_EVERY = 50;
  //: Longest time between two key frames [s]: a frame states its time since the last one in milliseconds, in 16 bits.
  const KEY_WITHIN = 30;
  //: Codec (VP9), and its bits per second for each pixel of a frame.
  const CODEC = "vp09.00.41.08", BITS = 4;

  //: Curves that are folded away.
  const FOLDED = "details:not([open]) > div";

  const size = (node) => node.getBoundingClientRect();

  // An empty canvas for the stages and the curves of a player; videos need even numbers of pixels.
  function blank({ root, parts }) {
    const width = size(root).width + 2 * MARGIN, height = HEAD + parts.reduce((sum, part) => sum + size(part).height + MARGIN, 0);
    const scale = Math.min(window.devicePixelRatio || 1, WIDEST / width), even = (length) => 2 * Math.round((length * scale) / 2);
    return Object.assign(document.createElement("canvas"), { width: even(width), height: even(height) });
  }

  // Paint the canvases, the colours of the legend, and the texts of the page; `words` stand in the line above.
  function paint(canvas, { root, parts }, words) {
    const pen = canvas.getContext("2d"), left = size(root).left - MARGIN, scale = canvas.width / (size(root).width + 2 * MARGIN);
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    Object.assign(pen, { fillStyle: "#fff", textBaseline: "middle" });
    pen.fillRect(0, 0, canvas.width, canvas.height);
    Object.assign(pen, { fillStyle: "#23262b", font: "15px system-ui, sans-serif" });
    pen.fillText(words, MARGIN, HEAD / 2);
    let top = HEAD;
    for (const part of parts) {
      const { top: before, height } = size(part), at = (box) => [box.left - left, box.top - before + top, box.width, box.height];
      for (const one of part.querySelectorAll("canvas")) if (!one.closest(FOLDED)) pen.drawImage(one, ...at(size(one)));
      for (const key of part.querySelectorAll("i")) {
        pen.fillStyle = getComputedStyle(key).backgroundColor;
        pen.fillRect(...at(size(key)));
      }
      const texts = document.createTreeWalker(part, NodeFilter.SHOW_TEXT), range = document.createRange();
      while (texts.nextNode()) {
        range.selectNodeContents(texts.currentNode);
        const holder = texts.currentNode.parentElement, style = getComputedStyle(holder), [x, y, wide, high] = at(size(range));
        if (!wide || holder.closest(`.buttons, ${FOLDED}`)) continue;
        if (holder.matches(".name, .force")) { pen.fillStyle = style.backgroundColor; pen.fillRect(...at(size(holder))); }
        Object.assign(pen, { fillStyle: style.color, font: `${style.fontWeight} ${style.fontSize} ${style.fontFamily}` });
        pen.fillText(texts.currentNode.data, x, y + high / 2, wide);
      }
      top += height + MARGIN;
    }
  }

  // A WebM file (RFC 9559) of frames { data, time [ms], key }: elements of an identifier, the length, and the contents.
  function webm({ width, height }, duration, frames) {
    const hex = (text) => Uint8Array.from(text.match(/../g), (two) => parseInt(two, 16));
    const wide = (kind, value) => { const view = new DataView(new ArrayBuffer(8)); view[`set${kind}`](0, value); return new Uint8Array(view.buffer); };
    const whole = (number) => wide("BigUint64", BigInt(Math.round(number)));
    const words = (text) => new TextEncoder().encode(text);
    const length = (parts) => parts.reduce((sum, part) => sum + part.length, 0);
    const joined = (parts) => { const all = new Uint8Array(length(parts)); let at = 0; for (const part of parts) { all.set(part, at); at += part.length; } return all; };
    // The first byte, 1, says that the length has the other seven.
    const item = (id, ...parts) => { const count = whole(length(parts)); count[0] = 1; return joined([hex(id), count, ...parts]); };
    const block = ({ data, time, key }, start) => item("a3", hex("81"), wide("Int16", time - start).subarray(0, 2), hex(key ? "80" : "00"), data);
    const clusters = [];
    for (const frame of frames) {
      if (frame.key) clusters.push({ start: frame.time, blocks: [] });
      const { start, blocks } = clusters[clusters.length - 1];
      blocks.push(block(frame, start));
    }
    const parts = [
      item("1549a966", item("2ad7b1", whole(1e6)), item("4489", wide("Float64", duration)), item("4d80", words("nonholonomic")), item("5741", words("nonholonomic"))),
      item("1654ae6b", item("ae", item("d7", whole(1)), item("73c5", whole(1)), item("83", whole(1)), item("86", words("V_VP9")),
        item("e0", item("b0", whole(width)), item("ba", whole(height))))),
    ];
    const cues = clusters.map(({ start, blocks }) => {
      const place = length(parts);
      parts.push(item("1f43b675", item("e7", whole(start)), ...blocks));
      return item("bb", item("b3", whole(start)), item("b7", item("f7", whole(1)), item("f1", whole(place))));
    });
    const head = item("1a45dfa3", item("4282", words("webm")), item("4287", whole(4)), item("4285", whole(2)));
    return new Blob([head, item("18538067", ...parts, item("1c53bb6b", ...cues))], { type: "video/webm" });
  }

  // Record a player at times of its run, `fps` of them per second of the film, however long the drawing takes.
  // `tell(share)` is told what share is done, and ends the film early by returning false.
  async function record(player, times, fps, tell) {
    const steps = times.slice(1, -1).map((time, k) => (time - times[k]) * fps), speed = steps[0];
    const uniform = steps.length > 0 && steps.every((step) => Math.abs(step - speed) < 1e-6 * speed);
    const words = !uniform ? "" : Math.abs(speed - 1) < 5e-3 ? ", real time" : `, ${Number(speed.toPrecision(3))} times real time`;
    const frames = [];
    let failure = null;
    player.play(false);
    player.root.classList.add("filming");
    player.seek(times[0]);
    const canvas = blank(player), bitrate = BITS * canvas.width * canvas.height, keyEvery = Math.min(KEY_EVERY, Math.ceil(KEY_WITHIN * fps));
    const encoder = new VideoEncoder({
      output: (chunk) => {
        const data = new Uint8Array(chunk.byteLength);
        chunk.copyTo(data);
        frames.push({ data, time: Math.round(chunk.timestamp / 1000), key: chunk.type === "key" });
      },
      error: (error) => { failure = error; },
    });
    try {
      encoder.configure({ codec: CODEC, width: canvas.width, height: canvas.height, bitrate, framerate: fps });
      for (const [k, time] of times.entries()) {
        player.orbit(60 / fps);
        player.seek(time);
        paint(canvas, player, `${time.toFixed(3)} s${words}`);
        const frame = new VideoFrame(canvas, { timestamp: (1e6 * k) / fps, duration: 1e6 / fps });
        encoder.encode(frame, { keyFrame: k % keyEvery === 0 });
        frame.close();
        if (tell((k + 1) / times.length) === false) break;
        while (encoder.encodeQueueSize > 1) await new Promise((next) => encoder.addEventListener("dequeue", next, { once: true }));
        if (failure) throw failure;
      }
      await encoder.flush();
    } finally {
      if (encoder.state !== "closed") encoder.close();
      player.root.classList.remove("filming");
    }
    return webm(canvas, (1000 * (frames.length - 1)) / fps, frames);
  }

  Object.assign(window.views, { blank, paint, record });
})();
