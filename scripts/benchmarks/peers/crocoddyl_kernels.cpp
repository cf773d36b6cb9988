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
  int64_t states, controls, horizon, mixed;
  double time_step;
  const double *p, *start, *lower, *upper;
};

static void run(int64_t kernel, std::initializer_list<const double*> arrays) {
  reinterpret_cast<void (*)(int64_t, int64_t, const double* const*)>(kernel)(0, 1, arrays.begin());
}

struct Action : crocoddyl::ActionModelAbstract {
  using Data = std::shared_ptr<crocoddyl::ActionDataAbstract>;
  using Vector = Eigen::Ref<const VectorXd>;
  Problem problem;
  VectorXd x_next, lx, lu;
  Rows A, B, lxx, luu, lux;

  explicit Action(const Problem& given)
      : crocoddyl::ActionModelAbstractTpl<double>(std::make_shared<crocoddyl::StateVector>(given.states), given.controls), problem(given),
        x_next(given.states), lx(given.states), lu(given.controls),
        A(Rows::Zero(given.states, given.states)), B(Rows::Zero(given.states, given.controls)),
        lxx(Rows::Zero(given.states, given.states)), luu(Rows::Zero(given.controls, given.controls)),
        lux(Rows::Zero(given.controls, given.states)) {
    set_u_lb(Map<const VectorXd>(given.lower, given.controls));
    set_u_ub(Map<const VectorXd>(given.upper, given.controls));
  }

  void calc(const Data& data, const Vector& x, const Vector& u) override {
    const double *h = &problem.time_step, *p = problem.p;
    if (p) run(problem.step, {x.data(), p, u.data(), h, x_next.data(), &data->cost});
    else run(problem.step, {x.data(), u.data(), h, x_next.data(), &data->cost});
    data->xnext = x_next;
  }

  void calcDiff(const Data& data, const Vector& x, const Vector& u) override {
    const double *h = &problem.time_step, *p = problem.p;
    const auto derivatives = problem.cost_derivatives;
    if (p) {
      run(problem.linearize, {x.data(), p, u.data(), h, A.data(), B.data()});
      run(derivatives, {x.data(), p, u.data(), lx.data(), lu.data(), lxx.data(), luu.data(), lux.data()});
    } else {
      run(problem.linearize, {x.data(), u.data(), h, A.data(), B.data()});
      run(derivatives, {x.data(), u.data(), lx.data(), lu.data(), lxx.data(), luu.data(), lux.data()});
    }
    data->Fx = A, data->Fu = B, data->Lx = lx, data->Lu = lu, data->Lxx = lxx, data->Luu = luu;
    if (problem.mixed) data->Lxu = lux.transpose();
  }

  void calc(const Data& data, const Vector& x) override {
    if (problem.p) run(problem.terminal_cost, {x.data(), problem.p, &data->cost});
    else run(problem.terminal_cost, {x.data(), &data->cost});
  }

  void calcDiff(const Data& data, const Vector& x) override {
    if (problem.p) run(problem.terminal_derivatives, {x.data(), problem.p, lx.data(), lxx.data()});
    else run(problem.terminal_derivatives, {x.data(), lx.data(), lxx.data()});
    data->Lx = lx, data->Lxx = lxx;
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
  const auto action = std::make_shared<Action>(*problem);
  const VectorXd start = Map<const VectorXd>(problem->start, n);
  const std::vector<std::shared_ptr<crocoddyl::ActionModelAbstract>> running(horizon, action);
  const auto shooting = std::make_shared<crocoddyl::ShootingProblem>(start, running, action);
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
