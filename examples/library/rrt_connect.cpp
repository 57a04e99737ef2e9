// A planner in C++ with certified motions, without Python: rapidly-exploring random trees that grow towards each other
// (RRT-Connect, Kuffner & LaValle 2000), then shortcuts by several threads, each with its own validator.
//
//   c++ -std=c++17 -O2 rrt_connect.cpp -lpgccd -o rrt_connect
//   ./rrt_connect arm.pgccd -1.5 0.3  1.5 0.3       the start, then the goal
#include <pgccd.h>

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <random>
#include <thread>
#include <vector>

namespace {

using State = std::vector<double>;
using Validator = std::unique_ptr<pgccd_validator, decltype(&pgccd_validator_free)>;

struct Tree {
  std::vector<State> states;
  std::vector<size_t> parent;
};

bool is_free(pgccd_validator* validator, const State& from, const State& to) {
  return pgccd_check_motion(validator, from.data(), to.data(), 0, nullptr) == PGCCD_FREE;
}

double distance(const State& a, const State& b) {
  double squared = 0.0;
  for (size_t k = 0; k < a.size(); ++k) squared += (a[k] - b[k]) * (a[k] - b[k]);
  return std::sqrt(squared);
}

size_t nearest(const Tree& tree, const State& to) {
  size_t best = 0;
  for (size_t k = 1; k < tree.states.size(); ++k) {
    if (distance(tree.states[k], to) < distance(tree.states[best], to)) best = k;
  }
  return best;
}

// Grows a tree towards a state; true if it was reached.
bool extend(pgccd_validator* validator, Tree& tree, const State& target, double step) {
  const size_t from = nearest(tree, target);
  const double away = distance(tree.states[from], target);
  State to = target;
  if (away > step) {
    for (size_t k = 0; k < to.size(); ++k) {
      to[k] = tree.states[from][k] + step / away * (target[k] - tree.states[from][k]);
    }
  }
  if (!is_free(validator, tree.states[from], to)) return false;
  tree.states.push_back(to);
  tree.parent.push_back(from);
  return away <= step;
}

std::vector<State> way_to_root(const Tree& tree) {
  std::vector<State> way;
  for (size_t k = tree.states.size() - 1;; k = tree.parent[k]) {
    way.push_back(tree.states[k]);
    if (k == 0) return way;
  }
}

std::vector<State> plan(pgccd_validator* validator, const State& start, const State& goal, std::mt19937& random) {
  Tree trees[2] = {{{start}, {0}}, {{goal}, {0}}};
  std::uniform_real_distribution<double> any(-3.0, 3.0);
  for (int k = 0; k < 20000; ++k) {
    Tree &grown = trees[k % 2], &other = trees[1 - k % 2];
    State target(start.size());
    for (double& value : target) value = any(random);
    const size_t before = grown.states.size();
    extend(validator, grown, target, 1.0);
    if (grown.states.size() == before) continue;
    const State reached = grown.states.back();
    size_t size = 0;
    while (size != other.states.size()) {
      size = other.states.size();
      if (!extend(validator, other, reached, 1.0)) continue;
      std::vector<State> first = way_to_root(trees[0]), second = way_to_root(trees[1]);
      std::vector<State> path(first.rbegin(), first.rend());
      path.insert(path.end(), second.begin() + 1, second.end());
      return path;
    }
  }
  return {};
}

// Leaves out waypoints between which the straight motion is free. Threads look at different pairs.
void shorten(const pgccd_validator* validator, std::vector<State>& path, unsigned threads) {
  for (bool is_shorter = true; is_shorter && path.size() > 2;) {
    is_shorter = false;
    std::vector<size_t> until(path.size());
    std::vector<std::thread> pool;
    for (unsigned t = 0; t < threads; ++t) {
      pool.emplace_back([&, t] {
        const Validator own(pgccd_validator_clone(validator), pgccd_validator_free);
        for (size_t k = t; k < path.size(); k += threads) {
          until[k] = k + 1;
          for (size_t n = path.size() - 1; n > k + 1; --n) {
            if (!is_free(own.get(), path[k], path[n])) continue;
            until[k] = n;
            break;
          }
        }
      });
    }
    for (std::thread& thread : pool) thread.join();
    std::vector<State> shorter;
    for (size_t k = 0; k < path.size(); k = until[k]) shorter.push_back(path[k]);
    is_shorter = shorter.size() < path.size();
    path = shorter;
  }
}

}  // namespace

int main(int count, char** arguments) {
  char message[512] = "";
  if (count < 2) return std::fputs("usage: rrt_connect FILE START... GOAL...\n", stderr), 2;
  const Validator validator(pgccd_validator_load(arguments[1], message, sizeof(message)), pgccd_validator_free);
  if (!validator) return std::fprintf(stderr, "%s\n", message), 2;
  const int width = pgccd_coordinate_count(validator.get());
  if (count != 2 + 2 * width) return std::fprintf(stderr, "expected 2 x %d values\n", width), 2;
  State start(width), goal(width);
  for (int k = 0; k < width; ++k) {
    start[k] = std::atof(arguments[2 + k]);
    goal[k] = std::atof(arguments[2 + width + k]);
  }
  std::mt19937 random(1);
  std::vector<State> path = plan(validator.get(), start, goal, random);
  if (path.empty()) return std::puts("no path"), 1;
  shorten(validator.get(), path, 2);
  for (const State& state : path) {
    for (const double value : state) std::printf("%.17g ", value);
    std::printf("\n");
  }
  return 0;
}
