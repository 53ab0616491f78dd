/* lavender for C++20: a solver that owns its memory, spans in place of pointers and counts, exceptions in place of codes.
 *
 *     lavender::problem q(LAV_BODIES);       // the fields of lav_problem; arrays by lavender::set(q.velocity, velocities)
 *     lavender::solver solver(LAV_NEWTON);   // grows with its problems and carries impulses by key
 *     solver.set(q);
 *     const lav_result result = solver.run();
 *     solver.velocity(v);
 *
 * Functions throw lavender::error, which names the rejected array. A solver moves and does not copy; one thread at a time
 * may use it. The arrays of a problem must live until `set` returns.
 */
#ifndef LAVENDER_HPP
#define LAVENDER_HPP

#include <cstdlib>
#include <memory>
#include <new>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>

#include "lavender.h"

namespace lavender {
/* An error code of the library in words. */
class error : public std::runtime_error {
 public:
  explicit error(int32_t code, const char *array = nullptr, int32_t index = 0)
      : std::runtime_error(array ? std::string(array) + "[" + std::to_string(index) + "]: " + lav_text(code) : lav_text(code)),
        code_(code) {}
  int32_t code() const noexcept { return code_; }

 private:
  int32_t code_;
};

inline void check(int32_t code) {
  if (code < LAV_OK) throw error(code);
}

/* A problem with the library's default values. */
struct problem : lav_problem {
  explicit problem(int32_t kind) : lav_problem() { check(lav_default_problem(kind, this)); }
};

/* Let a field of a problem point to an array; an empty array stands for the default value. */
template <class T>
void set(const T *&field, std::span<const T> values) {
  field = values.empty() ? nullptr : values.data();
}

inline lav_options default_options(int32_t method) {
  lav_options options;
  check(lav_default_options(method, &options));
  return options;
}

inline lav_budget default_budget() {
  lav_budget budget;
  check(lav_default_budget(&budget));
  return budget;
}
class solver {
 public:
  explicit solver(int32_t method) : solver(default_options(method)) {}
  explicit solver(const lav_options &options) : options_(options) {}

  /* Set a problem. The memory grows if the problem needs more; stored impulses move with it. */
  void set(const lav_problem &q) {
    if (!at_) {
      uint64_t bytes = 0;
      check(lav_workspace_size(&q, &options_, &bytes));
      buffer memory = allocate(bytes);
      lav_solver *at = nullptr;
      check(lav_open(memory.get(), bytes, &q, &options_, &at));
      at_.reset(at), memory_ = std::move(memory), bytes_ = bytes;
    }
    int32_t code;
    while ((code = lav_set(at_.get(), &q)) == LAV_ERROR_WORKSPACE) {
      const uint64_t needed = lav_needed(at_.get()), bytes = needed > 2 * bytes_ ? needed : 2 * bytes_;
      buffer memory = allocate(bytes);
      lav_solver *at = nullptr;
      check(lav_move(at_.get(), memory.get(), bytes, &at));
      at_.reset(at), memory_ = std::move(memory), bytes_ = bytes;
    }
    if (code != LAV_OK) {
      int32_t index = 0;
      const char *array = lav_refused(at_.get(), &index);
      throw error(code, array, index);
    }
    n_rows_ = q.n_rows;
  }

  lav_result run(const lav_budget &budget = default_budget()) {
    lav_result result;
    result.size = sizeof result;
    check(lav_run(handle(), &budget, &result));
    return result;
  }

  void impulse(std::span<double> out) { check(lav_impulse(handle(), out.data(), length(out))); } /* (m) N s */
  void velocity(std::span<double> out) { check(lav_velocity(handle(), out.data(), length(out))); } /* v+ */
  void free_velocity(std::span<double> out) { check(lav_free_velocity(handle(), out.data(), length(out))); } /* v* */

  /* Judge any impulse (m) [N s]; `slack` and `error` are empty or have m entries. */
  lav_verdict judge(std::span<const double> impulse, std::span<double> slack = {}, std::span<double> error_of_rows = {}) {
    lav_verdict verdict;
    verdict.size = sizeof verdict;
    if ((!slack.empty() && length(slack) != n_rows_) || (!error_of_rows.empty() && length(error_of_rows) != n_rows_))
      throw error(LAV_ERROR_COUNT);
    check(lav_judge(handle(), impulse.data(), length(impulse), slack.empty() ? nullptr : slack.data(),
                    error_of_rows.empty() ? nullptr : error_of_rows.data(), &verdict));
    return verdict;
  }

  /* Write the island of each block (k); return the number of islands. */
  int32_t islands(std::span<int32_t> label) {
    const int32_t count = lav_islands(handle(), label.data(), length(label));
    check(count);
    return count;
  }

  lav_solver *handle() { return at_ ? at_.get() : throw error(LAV_ERROR_NO_PROBLEM); } /* for other functions of the library */

 private:
  struct release {
    void operator()(void *memory) const noexcept { std::free(memory); }
    void operator()(lav_solver *) const noexcept {} /* lies in the memory above */
  };
  using buffer = std::unique_ptr<void, release>;

  static buffer allocate(uint64_t bytes) {
    buffer memory(std::malloc(bytes));
    return memory ? std::move(memory) : throw std::bad_alloc();
  }
  template <class T>
  static int32_t length(std::span<T> x) {
    return static_cast<int32_t>(x.size());
  }

  lav_options options_;
  buffer memory_;
  uint64_t bytes_ = 0;
  std::unique_ptr<lav_solver, release> at_;
  int32_t n_rows_ = 0;
};

}
#endif
