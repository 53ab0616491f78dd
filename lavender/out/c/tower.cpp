// The tower of tower.c in C++: the same bits.
#include <array>
#include <cstdio>

#include "lavender.hpp"

int main() try {
  const int boxes = 8;
  const double dt = 1.0 / 64, side[4][2] = {{-0.5, -0.5}, {0.5, -0.5}, {-0.5, 0.5}, {0.5, 0.5}};
  lavender::check(lav_self_test());
  lavender::solver solver(lavender::options(LAV_SEQUENTIAL_IMPULSES));
  lavender::contact_problem world;
  std::vector<double> x(3 * boxes), v(6 * boxes);
  lav_result result = {};
  world.bodies.resize(boxes);
  for (int i = 0; i < boxes; i++) {
    world.bodies[i].inv_mass = 1.0;
    for (int k = 0; k < 3; k++) world.bodies[i].inv_inertia[4 * k] = 6.0;
    x[3 * i] = 0.0625 * (i % 3), x[3 * i + 1] = 0.03125 * (i % 2), x[3 * i + 2] = 0.5 + 1.0 * i;
  }
  for (int step = 0; step < 120; step++) {
    world.contacts.clear();
    for (int i = 0; i < boxes; i++) {
      v[6 * i + 2] -= 9.75 * dt;
      for (int k = 0; k < 6; k++) world.bodies[i].velocity[k] = v[6 * i + k];
      for (int corner = 0; corner < 4; corner++) { // on what is below
        lavender::contact c;
        c.key = static_cast<std::uint64_t>(4 * i + corner), c.a = i - 1, c.b = i, c.mu = 0.5, c.normal[2] = c.tangent[0] = 1.0;
        for (int k = 0; k < 3; k++) {
          c.arm_b[k] = k == 2 ? -0.5 : side[corner][k];
          c.arm_a[k] = i == 0 ? 0.0 : x[3 * i + k] + c.arm_b[k] - x[3 * i - 3 + k];
        }
        c.target[0] = -(x[3 * i + 2] - 0.5 - (i == 0 ? 0.0 : x[3 * i - 1] + 0.5)) / dt; // -gap / dt
        world.contacts.push_back(c);
      }
    }
    solver.set(world.view());
    result = solver.run(lavender::budget());
    v = solver.velocity();
    for (int i = 0; i < boxes; i++)
      for (int k = 0; k < 3; k++) x[3 * i + k] += dt * v[6 * i + k];
  }
  std::printf("%s after %d sweeps, residual %.2e, floor %.0e, worst row %d\n", lav_outcome(result.outcome), result.sweeps,
              result.verdict.relative, result.verdict.floor, result.verdict.worst);
  std::printf("%016llx\n", static_cast<unsigned long long>(lavender::hash(v, lavender::hash(x))));
} catch (const lavender::error &problem) {
  std::fprintf(stderr, "lavender: %s\n", problem.what());
  return 1;
}
