// Kernels of the rounds in which collisions are resolved.
#pragma once

#include "kernels/device_context.h"
#include "kernels/executor.h"
#include "kernels/resolve/pair_motion_item.h"
#include "kernels/resolve/slowing_item.h"

namespace pgccd {

// Slows down all bodies that are about to collide, in place; changes (1,) is set to 1 if any body changes.
void slow_all_down(const Executor& executor, const SlowAllDown& bodies, int64_t* changes);
void slow_all_down(const DeviceContext& context, const SlowAllDown& bodies, int64_t* changes);

// Lowers the first toi of bodies to that of their contacts.
void lower_first_toi_of_bodies(const Executor& executor, const FirstToiInput& contacts, double* first);
void lower_first_toi_of_bodies(const DeviceContext& context, const FirstToiInput& contacts, double* first);

// The pairs to search (on a device in any order) and the shortened paths of their bodies, up to the capacity.
void shortened_pairs(const Executor& executor, const ShortenedPairs& given);
void shortened_pairs(const DeviceContext& context, const ShortenedPairs& given);

}  // namespace pgccd
