// Whether paths of a robot are free of contact at every time between their waypoints.
#pragma once

#include <cstdint>

#include "kernels/arms/arm.h"
#include "kernels/device_context.h"
#include "kernels/executor.h"

namespace pgccd {

// Names in the same order: pgccd/robots/certificate.py.
enum class Verdict : int8_t { kFree = 0, kCollision = 1, kNear = 2, kStart = 3, kInvalid = 4, kUndecided = 5 };

// Work on a path.
enum ArmCount : int { kSpans, kPairSpans, kArmNodeTests, kArmCandidates, kArmCounts };

struct PathVerdicts {
  int8_t* verdict;   // (paths,)
  int64_t* segment;  // of `toi`; -1 if the path is free or invalid
  double* toi;       // within the segment; infinite if the path is free
  int32_t* bodies;   // (paths, 2) that meet; -1 for none
  double* point;     // (paths, 3) where they meet, world; NaN for none
  int64_t* counts;   // (paths, kArmCounts)
};

// `resolution`: paths on which two bodies come as near as this may be reported as not free.
void certify(const Executor& executor, const ArmScene& scene, const ArmPaths& paths, double resolution,
             const PathVerdicts& out);
// One launch, in memory for the warps that the device holds. A search whose stack does not suffice is undecided.
void certify(const DeviceContext& context, const ArmScene& scene, const ArmPaths& paths, double resolution,
             const PathVerdicts& out);

}  // namespace pgccd
