// Crocoddyl on the kernels of our problem: actions that call them by address, and a solve with a clock.
// Compiled and called by crocoddyl_kernels.py.

#include <chrono>
#include <cstdint>
#include <memory>
#include <vector>

#include "crocoddyl/core/action-base.hpp"
#include "crocoddyl/core/optctrl/shooting.hpp"
#include "crocoddyl/core/solver-base.hpp"
#include "crocoddyl/core/solvers/box-ddp.hpp"
#include "crocoddyl/core/solvers/box-fddp.hpp"
#include "crocoddyl/core/states/euclidean.hpp"

using Clock = std::chrono::steady_clock;
using Eigen::Map;
using Eigen::MatrixXd;
using Eigen::VectorXd;
using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

struct Problem {
  int64_t step, terminal_cost, linearize, cost_derivatives, terminal_derivatives;  // addresses of kernels
  int64_t difference, retract;                                                     // 0: states are vectors
  int64_t rows, row_slopes, end_rows, end_slopes;                                  // 0: no constraints
  int64_t states, tangent, controls, horizon, mixed, parameters, n_rows, n_end;
  double time_step, weight;  // of the penalty w / 2 max(c, 0)^2, or w / 2 c^2 of the last rows, which are equalities
  int64_t n_equal;
  const double *p, *start, *lower, *upper, *emphasis, *margins, *end_margins;
};

static void run(int64_t kernel, std::initializer_list<const double*> arrays) {
  reinterpret_cast<void (*)(int64_t, int64_t, const double* const*)>(kernel)(0, 1, arrays.begin());
}

using Vector = Eigen::Ref<const VectorXd>;

// States whose differences the kernels know.
struct Manifold : crocoddyl::StateAbstractTpl<double> {
  Problem problem;
  explicit Manifold(const Problem& given) : StateAbstractTpl<double>(given.states, given.tangent), problem(given) {}
  VectorXd zero() const override { return Map<const VectorXd>(problem.start, problem.states); }
  VectorXd rand() const override { return zero(); }
  void diff(const Vector& x0, const Vector& x1, Eigen::Ref<VectorXd> dx) const override {
    run(problem.difference, {x0.data(), x1.data(), dx.data()});
  }
  void integrate(const Vector& x, const Vector& dx, Eigen::Ref<VectorXd> x_next) const override {
    run(problem.retract, {x.data(), dx.data(), x_next.data()});
  }
  // Derivatives of both, which no solver asks for.
  using Block = Eigen::Ref<MatrixXd>;
  using Which = crocoddyl::Jcomponent;
  void Jdiff(const Vector&, const Vector&, Block, Block, const Which) const override {}
  void Jintegrate(const Vector&, const Vector&, Block, Block, const Which, const crocoddyl::AssignmentOp) const override {}
  void JintegrateTransport(const Vector&, const Vector&, Block, const Which) const override {}
  std::shared_ptr<crocoddyl::StateBase> cloneAsDouble() const override { return nullptr; }
  std::shared_ptr<crocoddyl::StateBase> cloneAsFloat() const override { return nullptr; }
};

struct Action : crocoddyl::ActionModelAbstract {
  using Data = std::shared_ptr<crocoddyl::ActionDataAbstract>;
  Problem problem;
  const double* p;  // of this stage
  VectorXd x_next, lx, lu, rows, end_rows;
  Rows A, B, lxx, luu, lux, slopes, end_slopes;

  Action(const Problem& given, std::shared_ptr<crocoddyl::StateAbstract> state, int64_t stage)
      : crocoddyl::ActionModelAbstractTpl<double>(state, given.controls), problem(given),
        p(given.p ? given.p + stage * given.parameters : nullptr), x_next(given.states), lx(given.tangent), lu(given.controls),
        rows(given.n_rows), end_rows(given.n_end),
        A(Rows::Zero(given.tangent, given.tangent)), B(Rows::Zero(given.tangent, given.controls)),
        lxx(Rows::Zero(given.tangent, given.tangent)), luu(Rows::Zero(given.controls, given.controls)),
        lux(Rows::Zero(given.controls, given.tangent)), slopes(given.n_rows, given.tangent + given.controls),
        end_slopes(given.n_end, given.tangent) {
    set_u_lb(Map<const VectorXd>(given.lower, given.controls));
    set_u_ub(Map<const VectorXd>(given.upper, given.controls));
  }

  // A kernel on x, parameters if there are any, and others.
  void call(int64_t kernel, const double* x, std::initializer_list<const double*> others) {
    const double* arrays[12] = {x};
    int count = 1;
    if (p) arrays[count++] = p;
    for (const double* each : others) if (each) arrays[count++] = each;
    reinterpret_cast<void (*)(int64_t, int64_t, const double* const*)>(kernel)(0, 1, arrays);
  }

  // Violations of rows of which the last are equalities; returns their penalty.
  double penalize(VectorXd& c, const double* margins, int64_t equalities) {
    c += Map<const VectorXd>(margins, c.size());
    const auto inequalities = c.size() - equalities;
    c.head(inequalities) = c.head(inequalities).cwiseMax(0.0);
    return 0.5 * problem.weight * c.squaredNorm();
  }

  void calc(const Data& data, const Vector& x, const Vector& u) override {
    call(problem.step, x.data(), {u.data(), &problem.time_step, x_next.data(), &data->cost});
    data->xnext = x_next;
    if (problem.n_rows) {
      call(problem.rows, x.data(), {u.data(), rows.data()});
      data->cost += penalize(rows, problem.margins, 0);
    }
  }

  void calcDiff(const Data& data, const Vector& x, const Vector& u) override {
    call(problem.linearize, x.data(), {u.data(), &problem.time_step, A.data(), B.data()});
    const double* mixed = problem.mixed ? lux.data() : nullptr;
    call(problem.cost_derivatives, x.data(), {u.data(), lx.data(), lu.data(), lxx.data(), luu.data(), mixed});
    data->Fx = A, data->Fu = B, data->Lx = lx, data->Lu = lu, data->Lxx = lxx, data->Luu = luu;
    if (problem.mixed) data->Lxu = lux.transpose();
    if (problem.n_rows) {
      call(problem.rows, x.data(), {u.data(), rows.data()});
      call(problem.row_slopes, x.data(), {u.data(), slopes.data()});
      penalize(rows, problem.margins, 0);
      const auto n = problem.tangent, m = problem.controls;
      for (int64_t i = 0; i < problem.n_rows; ++i) {
        if (rows[i] == 0.0) continue;
        const VectorXd slope = slopes.row(i).transpose();
        const VectorXd pull = problem.weight * slope;
        data->Lx += rows[i] * pull.head(n), data->Lu += rows[i] * pull.tail(m);
        data->Lxx += pull.head(n) * slope.head(n).transpose(), data->Luu += pull.tail(m) * slope.tail(m).transpose();
        data->Lxu += pull.head(n) * slope.tail(m).transpose();
      }
    }
  }

  void calc(const Data& data, const Vector& x) override {
    call(problem.terminal_cost, x.data(), {problem.emphasis, &data->cost});
    if (problem.n_end) {
      call(problem.end_rows, x.data(), {end_rows.data()});
      data->cost += penalize(end_rows, problem.end_margins, problem.n_equal);
    }
  }

  void calcDiff(const Data& data, const Vector& x) override {
    call(problem.terminal_derivatives, x.data(), {problem.emphasis, lx.data(), lxx.data()});
    data->Lx = lx, data->Lxx = lxx;
    if (problem.n_end) {
      call(problem.end_rows, x.data(), {end_rows.data()});
      call(problem.end_slopes, x.data(), {end_slopes.data()});
      penalize(end_rows, problem.end_margins, problem.n_equal);
      for (int64_t i = 0; i < problem.n_end; ++i) {
        if (end_rows[i] == 0.0) continue;
        const VectorXd slope = end_slopes.row(i).transpose();
        data->Lx += problem.weight * end_rows[i] * slope;
        data->Lxx += problem.weight * slope * slope.transpose();
      }
    }
  }

  // Casts to other scalars, which no solver asks for.
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsDouble() const override { return nullptr; }
  std::shared_ptr<crocoddyl::ActionModelBase> cloneAsFloat() const override { return nullptr; }
};

struct Watch : crocoddyl::CallbackAbstract {
  double tolerance, *seconds, *costs;
  Clock::time_point start = Clock::now();
  void operator()(crocoddyl::SolverAbstract& solver) override {
    *seconds++ = std::chrono::duration<double>(Clock::now() - start).count();
    *costs++ = solver.get_cost();
    solver.set_th_stop(tolerance * solver.get_cost());
  }
};

// Solve from controls, and write those found over them; returns the iterations, negative without convergence.
extern "C" int solve(const Problem* problem, int feasible_start, int iterations, double regularization,
                     double tolerance, double* controls, double* seconds, double* costs) {
  const auto n = problem->states, m = problem->controls, horizon = problem->horizon;
  std::shared_ptr<crocoddyl::StateAbstract> state;
  if (problem->difference) state = std::make_shared<Manifold>(*problem);
  else state = std::make_shared<crocoddyl::StateVector>(n);
  const VectorXd start = Map<const VectorXd>(problem->start, n);
  std::vector<std::shared_ptr<crocoddyl::ActionModelAbstract>> running;
  for (int k = 0; k < horizon; ++k) running.push_back(std::make_shared<Action>(*problem, state, k));
  const auto end = std::make_shared<Action>(*problem, state, horizon);
  const auto shooting = std::make_shared<crocoddyl::ShootingProblem>(start, running, end);
  shooting->set_nthreads(1);
  std::unique_ptr<crocoddyl::SolverAbstract> solver;
  if (feasible_start) solver = std::make_unique<crocoddyl::SolverBoxDDP>(shooting);
  else solver = std::make_unique<crocoddyl::SolverBoxFDDP>(shooting);
  const auto watch = std::make_shared<Watch>();
  watch->tolerance = tolerance, watch->seconds = seconds, watch->costs = costs;
  solver->setCallbacks({watch});
  std::vector<VectorXd> us, xs(horizon + 1, start);
  for (int k = 0; k < horizon; ++k) us.push_back(Map<VectorXd>(controls + k * m, m));
  watch->start = Clock::now();
  if (feasible_start) xs = shooting->rollout_us(us);
  const bool converged = solver->solve(xs, us, iterations, feasible_start, regularization);
  for (int k = 0; k < horizon; ++k) Map<VectorXd>(controls + k * m, m) = solver->get_us()[k];
  const int done = static_cast<int>(watch->costs - costs);
  return converged ? done : -done;
}
