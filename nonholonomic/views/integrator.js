// The loops over steps and stages, rounds and flights. Everything else is generated from Python (`explore.py`) and is
// in `model`: the equations, the coefficients of the Runge-Kutta pair, the first step, step-size control, the location of
// events, and what happens between the modes.
"use strict";

function integrator(model) {
  // The steps of one smooth motion.
  function stepper(model) {
    const n = model.components, at = model.lane, stages = model.stages.length;
    const [constants, lane] = [new Float64Array(model.constants), new Float64Array(at.size)];
    const start = new Float64Array(model.constants + at.size);
    const rates = Array.from({ length: stages + 2 }, () => new Float64Array(n));
    const [there, time, length, number] = [new Float64Array(n), new Float64Array(1), new Float64Array(1), [1]];
    // Like `Step` in Python: state, rate, error, the least of margins and event function at the end, the first place at which one of
    // them was negative, the margins at the start, at the checked stages and at the end, and the state in the middle.
    const m = model.margins_count, rows = model.looks.length + 2, tried = new Float64Array(4 * n + 2 + rows * m);
    const middle = tried.subarray(3 * n + 2 + rows * m);
    const [end, last, error] = [0, 1, 2].map((k) => tried.subarray(k * n, (k + 1) * n));
    const margins = Array.from({ length: rows }, (_, k) => tried.subarray(3 * n + 2 + k * m, 3 * n + 2 + (k + 1) * m));

    // there = state + length * (weights . rates)
    function move(there, state, length, weights) {
      for (let k = 0; k < n; k++) {
        let sum = 0;
        for (let j = 0; j < weights.length; j++) if (weights[j] !== 0) sum += weights[j] * rates[j][k];
        there[k] = state[k] + length * sum;
      }
    }
    const none = new Float64Array(n);
    const value = (function_, ...inputs) => (number.length = 0, function_(...inputs, number), number.length ? number[0] : Infinity);

    // Write the margins into a row, and return the least of them and of the event function.
    function least(row, time, state, rate, side) {
      model.margins(constants, time, state, margins[row]);
      // Zero is beyond the event.
      return Math.min(...margins[row], side * value(model.crossing, constants, state, rate) + (side < 0 ? 1e-300 : 0));
    }

    // Write one step from a state with a known rate into `tried`; without `watches`, compute only the end of the step.
    function step(from, state, rate, side, length, watches = true) {
      rates[0].set(rate);
      let negative = 2;
      for (let stage = 0; stage < stages; stage++) {
        move(there, state, length, model.stages[stage]);
        time[0] = from + model.places[stage] * length;
        model.field(constants, time, there, rates[stage + 1]);
        const row = model.looks.indexOf(stage) + 1;
        if (watches && row > 0 && least(row, time, there, rates[stage + 1], side) < 0) negative = Math.min(negative, model.places[stage]);
      }
      move(end, state, length, model.step);
      if (!watches) return;
      time[0] = from + length;
      model.field(constants, time, end, last);
      rates[stages + 1].set(last);
      move(error, none, length, model.error);
      move(middle, state, length, model.middle);
      const margin = least(rows - 1, time, end, last, side);
      tried[3 * n] = margin === Infinity ? 1 : margin;
      tried[3 * n + 1] = negative;
    }

    // Run from the start given by `inputs` to the end of the run; `record` is called for every accepted step.
    function run(inputs, record) {
      model.begin(...inputs, start);
      constants.set(start.subarray(0, model.constants));
      lane.set(start.subarray(model.constants));
      const [state, rate] = [lane.subarray(at.state, at.state + n), lane.subarray(at.rate, at.rate + n)];
      const held = record && constants.slice();
      while (lane[at.status] === model.running) {
        model.length(constants, lane, length);
        margins[0].set(lane.subarray(at.margins, at.margins + m));
        const from = lane[at.time], before = record && { time: from, state: state.slice(), rate: rate.slice(), length: length[0], constants: held };
        step(from, state, rate, lane[at.side], length[0]);
        model.after(constants, lane, length, tried, lane);
        if (record && lane[at.time] > from) record(before);
      }
    }

    // The state at a time within a recorded step, by a shorter step from the same start, which does not pass a jump.
    function within(one, wanted) {
      constants.set(one.constants);
      step(one.time, one.state, one.rate, 1, Math.min(wanted - one.time, one.length), false);
      return end;
    }
    return { run, within, constants, lane };
  }

  // Each round integrates one mode to its end, and its transition leads to the next mode.
  const kinds = model.kinds.map((kind) => ({ ...kind, motion: stepper(kind) })), at = model.runs, runs = new Float64Array(at.size);

  function run(values, record) {
    model.first(values, runs);
    for (let round = 0; round < model.rounds && runs[at.status] === model.running; round++) {
      const kind = kinds[model.modes[runs[at.mode]]], { motion } = kind, before = record && runs.slice(), began = runs[at.end_time];
      motion.run([values, runs], record && ((one) => record({
        time: began + one.time,
        mode: before[at.mode],
        rows: (wanted) => kind.shown(values, before, motion.within(one, wanted - began), []),
      })));
      kind.ended(motion.constants, motion.lane, values, runs, runs);
      if (runs[at.status] === model.left) leave(kind, values, record);
    }
    if (runs[at.status] === model.running) runs[at.status] = model.unresolved;
    return runs;
  }

  // The transition at the end of a mode: instantaneous, or through flights that end with impacts.
  function leave(kind, values, record) {
    if (kind.reset) { kind.reset(values, runs, runs); return; }
    const before = runs.slice(), began = runs[at.end_time];
    let [open, elapsed, ...stretch] = kind.lost(values, before, []);
    for (let hops = 0; open && hops < kind.most_hops; hops++) {
      const from = stretch, start = elapsed;
      [open, elapsed, ...stretch] = kind.hop(values, before, from, []);
      if (record && elapsed > start) {
        record({ time: began + start, mode: -1, rows: (wanted) => kind.between(values, before, from, [wanted - began - start], []) });
      }
    }
    kind.closed(values, before, stretch, runs);
  }

  // A run with its pieces in order, each with the `time` at which it begins, which is read at increasing times.
  function trajectory(values, reading) {
    const pieces = [];
    run(values, (piece) => pieces.push(piece));
    if (!pieces.length) {
      const kind = kinds[model.modes[runs[at.mode]]], state = runs.slice(at.state, at.state + kind.components);
      pieces.push({ time: 0, mode: runs[at.mode], rows: () => kind.shown(values, runs, state, []) });
    }
    const read = (times) => {
      let k = 0;
      return Array.from(times, (wanted) => {
        while (k + 1 < pieces.length && pieces[k + 1].time <= wanted) k++;
        return Float64Array.from(model[reading](values, [pieces[k].mode], pieces[k].rows(wanted), [wanted], []));
      });
    };
    return { end: runs[at.end_time], steps: pieces.length, read };
  }

  return { run, trajectory, read: (name, values) => model[name](values, runs, []) };
}
