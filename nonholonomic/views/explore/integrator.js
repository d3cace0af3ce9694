// The loops over steps and stages. All else is generated from Python (`simulator.py`) and stands in `model`: the equations, the
// coefficients of the Runge-Kutta pair, the first step, step-size control and the location of events.
"use strict";

function integrator(model) {
  const n = model.components, at = model.lane, stages = model.stages.length;
  const [constants, lane] = [new Float64Array(model.constants), new Float64Array(at.size)];
  const start = new Float64Array(model.constants + at.size);
  const rates = Array.from({ length: stages + 2 }, () => new Float64Array(n));
  const [there, time, length, number] = [new Float64Array(n), new Float64Array(1), new Float64Array(1), [1]];
  // As a `Step` of Python: state, rate, error, the least of margins and event function at the end, where one was negative before, and
  // the margins at the start, at the stages that are looked at, and at the end.
  const m = model.kinds, rows = model.looks.length + 2, tried = new Float64Array(3 * n + 2 + rows * m);
  const [end, last, error] = [0, 1, 2].map((k) => tried.subarray(k * n, (k + 1) * n));
  const margins = Array.from({ length: rows }, (_, k) => tried.subarray(3 * n + 2 + k * m, 3 * n + 2 + (k + 1) * m));

  // There = state + length * (weights . rates).
  function move(there, state, length, weights) {
    for (let k = 0; k < n; k++) {
      let sum = 0;
      for (let j = 0; j < weights.length; j++) if (weights[j] !== 0) sum += weights[j] * rates[j][k];
      there[k] = state[k] + length * sum;
    }
  }
  const none = new Float64Array(n);
  const value = (function_, ...inputs) => (number.length = 0, function_(...inputs, number), number.length ? number[0] : Infinity);

  // The least of the margins, which are written into a row, and of the event function.
  function least(row, time, state, rate, side) {
    model.margins(constants, time, state, margins[row]);
    return Math.min(...margins[row], side * value(model.crossing, constants, state, rate));
  }

  // One step from a state at a time, whose rate is known, written into `tried`; only its end where nobody watches for events.
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
    const margin = least(rows - 1, time, end, last, side);
    tried[3 * n] = margin === Infinity ? 1 : margin;
    tried[3 * n + 1] = negative;
  }

  // Runs from the start that the sliders' numbers say; `record` is called with the start and the length of each step that is taken.
  function run(values, record) {
    model.begin(values, start);
    constants.set(start.subarray(0, model.constants));
    lane.set(start.subarray(model.constants));
    const [state, rate] = [lane.subarray(at.state, at.state + n), lane.subarray(at.rate, at.rate + n)];
    while (lane[at.status] === model.running) {
      model.length(constants, lane, length);
      margins[0].set(lane.subarray(at.margins, at.margins + m));
      const from = lane[at.time], before = record && { time: from, state: state.slice(), rate: rate.slice() };
      step(from, state, rate, lane[at.side], length[0]);
      model.after(constants, lane, length, tried, lane);
      if (record && lane[at.time] > from) record({ ...before, length: lane[at.time] - from });
    }
    return lane;
  }

  // A run with its steps kept: what is read off it at any times within it, by shorter steps from where its steps begin.
  function trajectory(values, reading) {
    const steps = [];
    run(values, (one) => steps.push(one));
    const ended = lane[at.time], copy = lane.slice();
    function read(times) {
      const found = [];
      let k = 0;
      for (const wanted of times) {
        while (k + 1 < steps.length && steps[k + 1].time <= wanted) k++;
        if (steps.length) {
          step(steps[k].time, steps[k].state, steps[k].rate, 1, wanted - steps[k].time, false);
          copy.set(end, at.state);
          copy[at.time] = wanted;
        }
        found.push(Float64Array.from(model[reading](values, constants, copy, [])));
      }
      return found;
    }
    return { end: ended, steps: steps.length, read };
  }

  return { run, trajectory, read: (name, values) => model[name](values, constants, lane, []) };
}
