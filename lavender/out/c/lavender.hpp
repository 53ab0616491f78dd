// lavender.h for C++11 and later: a problem that owns its arrays, a solver that owns its memory, errors thrown here alone.
#ifndef LAVENDER_HPP
#define LAVENDER_HPP

#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "lavender.h"

namespace lavender {

template <class T>
struct span { // what std::span of C++20 is, as far as it is needed
  T *at = nullptr;
  std::size_t count = 0;
  span() = default;
  span(T *begin, std::size_t n) : at(begin), count(n) {}
  template <class Range>
  span(Range &range) : at(range.data()), count(range.size()) {}
  T *begin() const { return at; }
  T *end() const { return at + count; }
  std::size_t size() const { return count; }
  T &operator[](std::size_t i) const { return at[i]; }
};

struct error : std::runtime_error {
  std::int32_t code;
  explicit error(std::int32_t given, const std::string &where = "") : std::runtime_error(where + lav_text(given)), code(given) {}
};

inline std::int32_t check(std::int32_t code) {
  if (code < 0) throw error(code);
  return code;
}

inline lav_options options(std::int32_t method) {
  lav_options made;
  check(lav_default_options(method, &made));
  return made;
}

inline lav_budget budget(std::int32_t iterations = 1000, double tol = 1e-6) {
  lav_budget made;
  check(lav_default_budget(&made));
  made.iterations = iterations;
  made.tol = tol;
  return made;
}

struct body {
  double inv_mass = 0.0;          // 1/kg; 0: moved by nothing
  double inv_inertia[9] = {};     // 1/(kg m^2), world
  double velocity[6] = {};        // m/s, rad/s, without constraint impulses
};

struct contact {
  std::uint64_t key = 0;          // the same in the next step: its impulse is carried
  std::int32_t a = -1, b = -1;    // bodies; -1: the world
  double normal[3] = {}, tangent[3] = {}, arm_a[3] = {}, arm_b[3] = {};
  double target[3] = {};          // m/s: -gap / dt on the normal
  double mu = 0.0;
};

// Bodies and contacts of three rows, as lav_problem wants them.
class contact_problem {
 public:
  std::vector<body> bodies;
  std::vector<contact> contacts;

  // The view is good until the next call or the end of this object.
  const lav_problem &view() {
    const std::size_t n = bodies.size(), c = contacts.size();
    check(lav_default_problem(LAV_BODIES, &problem_));
    ptr_.assign(c + 1, 0), kind_.assign(c, LAV_CONTACT), pair_.resize(2 * c), key_.resize(c), mu_.resize(c);
    numbers_.resize(16 * n + 15 * c);
    double *mass = numbers_.data(), *inertia = mass + n, *v = inertia + 9 * n, *list[5];
    for (int i = 0; i < 5; i++) list[i] = v + 6 * n + 3 * c * static_cast<std::size_t>(i);
    for (std::size_t i = 0; i < n; i++) {
      mass[i] = bodies[i].inv_mass;
      for (std::size_t k = 0; k < 9; k++) inertia[9 * i + k] = bodies[i].inv_inertia[k];
      for (std::size_t k = 0; k < 6; k++) v[6 * i + k] = bodies[i].velocity[k];
    }
    for (std::size_t i = 0; i < c; i++) {
      const contact &q = contacts[i];
      ptr_[i + 1] = ptr_[i] + 3, pair_[2 * i] = q.a, pair_[2 * i + 1] = q.b, key_[i] = q.key, mu_[i] = q.mu;
      const double *from[5] = {q.normal, q.tangent, q.arm_a, q.arm_b, q.target};
      for (std::size_t t = 0; t < 5; t++)
        for (std::size_t k = 0; k < 3; k++) list[t][3 * i + k] = from[t][k];
    }
    problem_.n_bodies = static_cast<std::int32_t>(n), problem_.n_blocks = static_cast<std::int32_t>(c);
    problem_.n_rows = 3 * problem_.n_blocks;
    problem_.block_ptr = ptr_.data(), problem_.kind = kind_.data(), problem_.contact_body = pair_.data();
    problem_.key = key_.data(), problem_.mu = mu_.data(), problem_.inv_mass = mass, problem_.inv_inertia = inertia;
    problem_.velocity = v, problem_.normal = list[0], problem_.tangent = list[1], problem_.arm_a = list[2];
    problem_.arm_b = list[3], problem_.target = list[4];
    return problem_;
  }

 private:
  lav_problem problem_;
  std::vector<std::int32_t> ptr_, kind_, pair_;
  std::vector<std::uint64_t> key_;
  std::vector<double> mu_, numbers_;
};

// A solver and its memory, which at least doubles where a problem asks for more; impulses move with it.
class solver {
 public:
  explicit solver(const lav_options &given) : options_(given) {}

  void set(const lav_problem &problem) {
    if (!at_) open(problem);
    std::int32_t code = lav_set(at_, &problem);
    for (int turn = 0; code == LAV_ERROR_ROOM && turn < 40; turn++) {
      grow();
      code = lav_set(at_, &problem);
    }
    if (code < 0) {
      std::int32_t index = 0;
      const char *array = lav_refused(at_, &index);
      throw error(code, array ? std::string(array) + "[" + std::to_string(index) + "]: " : "");
    }
    rows_ = static_cast<std::size_t>(problem.n_rows);
    speeds_ = problem.form == LAV_BODIES ? 6 * static_cast<std::size_t>(problem.n_bodies)
                                         : static_cast<std::size_t>(problem.n_velocities);
  }
  lav_result run(const lav_budget &budget) {
    lav_result out = {};
    out.size = static_cast<std::uint32_t>(sizeof out);
    check(lav_run(at_, &budget, &out));
    return out;
  }
  std::vector<double> impulse() {
    std::vector<double> out(rows_);
    check(lav_impulse(at_, out.data(), static_cast<std::int32_t>(rows_)));
    return out;
  }
  std::vector<double> velocity() {
    std::vector<double> out(speeds_);
    check(lav_velocity(at_, out.data(), static_cast<std::int32_t>(speeds_)));
    return out;
  }
  lav_verdict judge(span<const double> impulse) {
    lav_verdict out = {};
    out.size = static_cast<std::uint32_t>(sizeof out);
    check(lav_judge(at_, impulse.at, static_cast<std::int32_t>(impulse.count), nullptr, nullptr, &out));
    return out;
  }
  lav_solver *get() const { return at_; }

 private:
  void open(const lav_problem &problem) {
    check(lav_room(&problem, &options_, &bytes_));
    memory_.reset(new double[bytes_ / 8 + 2]);
    check(lav_open(memory_.get(), bytes_, &problem, &options_, &at_));
  }
  void grow() {
    const std::uint64_t needed = lav_needed(at_);
    bytes_ = needed > 2 * bytes_ ? needed : 2 * bytes_;
    std::unique_ptr<double[]> more(new double[bytes_ / 8 + 2]);
    check(lav_move(at_, more.get(), bytes_, &at_));
    memory_.swap(more);
  }
  lav_options options_;
  std::uint64_t bytes_ = 0;
  std::unique_ptr<double[]> memory_;
  lav_solver *at_ = nullptr;
  std::size_t rows_ = 0, speeds_ = 0;
};

inline std::uint64_t hash(span<const double> x, std::uint64_t seed = 0) {
  return lav_hash(x.at, static_cast<std::int32_t>(x.count), seed);
}

} // namespace lavender
#endif
