// The loops of a run in one thread: over steps and stages, over rounds, and over the stretches of a transition. Everything else
// is generated from Python (`device_code.py`) and follows this text: the equations, the coefficients of the Runge-Kutta pair, the
// first step, step-size control, the location of events, and what happens between the modes. The loops are those of
// `integrator.js`. The same text compiles for the host, where it is a function that runs one cell after another.

#ifdef __CUDACC_RTC__
// Functions are written out where they are used, or called if they are large.
#define DEVICE __device__ __forceinline__
#define UNROLLED _Pragma("unroll")
#define CALLED __device__ __noinline__
#define KERNEL extern "C" __global__ void __launch_bounds__(64)
#define NaN __longlong_as_double(0x7ff8000000000000LL)
#define Infinity __longlong_as_double(0x7ff0000000000000LL)
#define NEXT atomicAdd(queue, 1ULL)
#else
#include <cmath>
#include <limits>
using namespace std;
#define DEVICE inline
#define CALLED inline
#define KERNEL extern "C" void
#define NaN std::numeric_limits<double>::quiet_NaN()
#define Infinity std::numeric_limits<double>::infinity()
#define NEXT (*queue)++
#define UNROLLED
inline double rsqrt(double x) { return 1.0 / sqrt(x); }
#endif

DEVICE static double greatest(double a, double b) { return a > b || a != a ? a : b; }
DEVICE static double least(double a, double b) { return a < b || a != a ? a : b; }
DEVICE static double sign(double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x; }
DEVICE static bool is_finite(double x) { return fabs(x) < Infinity; }
DEVICE static double logistic(double x) { return 1.0 / (1.0 + exp(-x)); }

// A generated type `M` is one smooth motion: its functions, the sums and places of its stages, and the numbers of its
// `components`, of its `stages` and of those that `look` at margins, of its `margins_count`, and of its `constants`. Its lists:
// a start is the constants, then the lane, whose parts begin at `lane_status` and so on; `runs` is a `HybridOutcome`.

// The margins, and the least of them and of the event function.
template <class M>
DEVICE double least_margin(const double* constants, const double* time, const double* state, const double* rate, double side,
                           double* margins) {
  M::margins(constants, time, state, margins);
  double result = Infinity;
  UNROLLED for (int k = 0; k < M::margins_count; k++) result = least(result, margins[k]);
  if constexpr (M::has_event) {
    double value;
    M::crossing(constants, state, rate, &value);
    // Zero is beyond the event.
    result = least(result, side * value + (side < 0.0 ? 1e-300 : 0.0));
  }
  return result;
}

// The stages of a step from one on: their rates, the margins at the checked ones, and the first of these at which one was negative.
template <class M, int stage, bool watches>
DEVICE void take_stages(const double* constants, double from, const double* state, double side, double length,
                        double (*rates)[M::components], double* watched, double& negative) {
  if constexpr (stage < M::stages) {
    double there[M::components], time = from + M::template place<stage>() * length;
    UNROLLED for (int k = 0; k < M::components; k++) there[k] = state[k] + length * M::template sum<stage>(rates, k);
    M::field(constants, &time, there, rates[stage + 1]);
    if constexpr (constexpr int row = M::template look<stage>(); watches && row > 0) {
      double* const margins = watched + row * M::margins_count;
      if (least_margin<M>(constants, &time, there, rates[stage + 1], side, margins) < 0.0)
        negative = least(negative, M::template place<stage>());
    }
    take_stages<M, stage + 1, watches>(constants, from, state, side, length, rates, watched, negative);
  }
}

// One step from a state with a known rate, like `Step` in Python: state, rate, error, the least of margins and event function at
// the end, the first place at which one of them was negative, the margins at the start, at the checked stages and at the end,
// and the state in the middle.
template <class M>
DEVICE void try_step(const double* constants, double from, const double* state, const double* rate, const double* margins,
                     double side, double length, double* tried) {
  constexpr int n = M::components, m = M::margins_count, stages = M::stages, rows = M::looks + 2;
  double rates[stages + 2][n], time = from + length, negative = 2.0;
  double *const end = tried, *const last = tried + n, *const error = tried + 2 * n, *const watched = tried + 3 * n + 2;
  double* const middle = watched + rows * m;
  UNROLLED for (int k = 0; k < m; k++) watched[k] = margins[k];
  UNROLLED for (int k = 0; k < n; k++) rates[0][k] = rate[k];
  take_stages<M, 0, true>(constants, from, state, side, length, rates, watched, negative);
  UNROLLED for (int k = 0; k < n; k++) end[k] = state[k] + length * M::template sum<stages>(rates, k);
  M::field(constants, &time, end, last);
  UNROLLED for (int k = 0; k < n; k++) {
    rates[stages + 1][k] = last[k];
    error[k] = length * M::template sum<stages + 1>(rates, k);
    middle[k] = state[k] + length * M::template sum<stages + 2>(rates, k);
  }
  const double margin = least_margin<M>(constants, &time, end, last, side, watched + (rows - 1) * m);
  tried[3 * n] = margin == Infinity ? 1.0 : margin;
  tried[3 * n + 1] = negative;
}

// The state at a time within a step, by a shorter step from the same start.
template <class M>
DEVICE void within(const double* constants, double from, const double* state, const double* rate, double length, double* there) {
  double rates[M::stages + 2][M::components], negative;
  UNROLLED for (int k = 0; k < M::components; k++) rates[0][k] = rate[k];
  take_stages<M, 0, false>(constants, from, state, 1.0, length, rates, there, negative);
  UNROLLED for (int k = 0; k < M::components; k++) there[k] = state[k] + length * M::template sum<M::stages>(rates, k);
}

// The samples of a run: their times, how many there are, the next one, and where their values go, each `stride` after the last.
struct Samples {
  const double* times;
  int count, next;
  double* values;
  long long stride;

  // Write the samples up to a time, and `read` each.
  template <int size, class Read>
  DEVICE void write(double until, Read read) {
    for (; next < count && times[next] <= until; next++) {
      double row[size];
      read(times[next], row);
      for (int k = 0; k < size; k++) values[((long long)next * size + k) * stride] = row[k];
    }
  }
};

// Run one smooth motion, whose constants and lane are given, to its end.
template <class M, class Record>
DEVICE void run_motion(double* start, Record record) {
  constexpr int n = M::components, m = M::margins_count;
  // Copies, which stay in registers: called functions have written and will read the originals.
  double constants[M::constants], lane[M::lane_size];
  UNROLLED for (int k = 0; k < M::constants; k++) constants[k] = start[k];
  UNROLLED for (int k = 0; k < M::lane_size; k++) lane[k] = start[M::constants + k];
  while (lane[M::lane_status] == M::running) {
    double length, tried[4 * n + 2 + (M::looks + 2) * m];
    M::length(constants, lane, &length);
    try_step<M>(constants, lane[M::lane_time], lane + M::lane_state, lane + M::lane_rate, lane + M::lane_margins,
                lane[M::lane_side], length, tried);
    const double from = lane[M::lane_time];
    double state[n], rate[n];
    UNROLLED for (int k = 0; k < n; k++) state[k] = lane[M::lane_state + k], rate[k] = lane[M::lane_rate + k];
    M::after(constants, lane, &length, tried, lane);
    if (lane[M::lane_time] > from) record(constants, from, state, rate, length, lane[M::lane_time]);
  }
  UNROLLED for (int k = 0; k < M::lane_size; k++) start[M::constants + k] = lane[k];
}

// In place of a function that keeps the accepted steps.
struct NoRecord {
  DEVICE void operator()(const double*, double, const double*, const double*, double, double) const {}
};

// Run a smooth problem from its start to its end.
template <class M>
DEVICE void run_smooth(const double* values, double* outcome) {
  double start[M::constants + M::lane_size];
  M::begin(values, start);
  run_motion<M>(start, NoRecord());
  M::ended(start, start + M::constants, values, outcome);
}

// Run a smooth problem, and sample it; samples after the end are NaN.
template <class M>
DEVICE void run_sampled(const double* values, double* outcome, Samples samples) {
  double start[M::constants + M::lane_size];
  M::begin(values, start);
  const double* const first = start + M::constants + M::lane_state;
  samples.write<M::quantities>(0.0, [=](double, double* row) { M::read(values, first, row); });
  run_motion<M>(start, [&](const double* constants, double from, const double* state, const double* rate, double length,
                           double until) {
    samples.write<M::quantities>(until, [=](double time, double* row) {
      double there[M::components];
      // A step that ends on a jump does not pass it.
      within<M>(constants, from, state, rate, least(time - from, length), there);
      M::read(values, there, row);
    });
  });
  M::ended(start, start + M::constants, values, outcome);
  samples.write<M::quantities>(Infinity, [](double, double* row) { for (int k = 0; k < M::quantities; k++) row[k] = NaN; });
}

// One round: a mode to its end, and the transition, which is instantaneous or goes through flights that end with impacts.
template <class M>
DEVICE void one_round(const double* values, double* runs) {
  double start[M::constants + M::lane_size];
  M::begin(values, runs, start);
  run_motion<M>(start, NoRecord());
  M::ended(start, start + M::constants, values, runs, runs);
  if (runs[M::runs_status] != M::left) return;
  if constexpr (M::most_hops == 0) {
    M::reset(values, runs, runs);
  } else {
    // Whether the stretch is open, the time since the end of the mode, and the stretch.
    double current[2 + M::stretch];
    M::lost(values, runs, current);
    for (int hops = 0; current[0] != 0.0 && hops < M::most_hops; hops++) M::hop(values, runs, current + 2, current);
    M::closed(values, runs, current + 2, runs);
  }
}

// Each round integrates one mode to its end, and its transition leads to the next mode.
template <class R>
DEVICE void run_rounds(const double* values, double* runs) {
  R::first(values, runs);
  for (int round = 0; round < R::rounds && runs[R::runs_status] == R::running; round++) R::advance(values, runs);
  if (runs[R::runs_status] == R::running) runs[R::runs_status] = R::unresolved;
}
