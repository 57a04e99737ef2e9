/* Motions of a robot between configurations, certified free of contact at every time between them: on a CPU, without
 * Python. A validator is made by pgccd in Python, `robot.motion_validator(obstacles).save(path)`, and loaded here.
 *
 * Lengths and angles are those of the robot's description (radians). A validator is used by one thread at a time: use
 * by two is an error, PGCCD_BUSY. Functions do not throw; those that fail say why in `message`. */
#ifndef PGCCD_H
#define PGCCD_H

#include <stddef.h>
#include <stdint.h>

#if defined(__GNUC__)
#define PGCCD_API __attribute__((visibility("default")))
#else
#define PGCCD_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

typedef struct pgccd_validator pgccd_validator;

/* Of motions; in the order of `pgccd.robots.Verdict`. Of errors: negative. */
enum {
  PGCCD_FREE = 0,      /* certainly free of contact, both ends included */
  PGCCD_COLLISION = 1, /* not told apart from PGCCD_NEAR here */
  PGCCD_NEAR = 2,      /* two bodies touch, or come within the resolution */
  PGCCD_START = 3,     /* two bodies touch at the start */
  PGCCD_INVALID = 4,   /* a value is not finite, or too large */
  PGCCD_UNDECIDED = 5, /* the budget was spent */
  PGCCD_BUSY = -1      /* another thread uses the validator */
};

typedef struct {
  double free_until;  /* the part of the motion, in [0, 1], before which it is certainly free; 1 only if all of it is */
  int32_t bodies[2];  /* that meet; -1 for none. Bodies of the robot come first, then obstacles */
  double point[3];    /* where they meet, world frame; NaN for none */
  int64_t pair_spans; /* body pairs tested over parts of the motion */
} pgccd_motion;

/* A table of a validator: contiguous rows, in the order in which Python writes them. */
typedef struct {
  const void* data;
  int64_t shape[3];
  int32_t dimensions;
  int32_t type; /* 0 uint8, 1 int32, 2 int64, 3 float32, 4 float64 */
} pgccd_table;

/* Null on failure. The tables are not copied, and must outlive the validator and its clones. */
PGCCD_API pgccd_validator* pgccd_validator_new(const pgccd_table* tables, int32_t count, double room, double resolution,
                                               char* message, size_t message_size);
/* From a file. */
PGCCD_API pgccd_validator* pgccd_validator_load(const char* path, char* message, size_t message_size);
/* Writes it to a file. Returns 0, or -1 on failure. */
PGCCD_API int32_t pgccd_validator_save(const pgccd_validator* validator, const char* path, char* message,
                                       size_t message_size);
/* Another one, for another thread. It shares the tables, which live until the last one is freed. */
PGCCD_API pgccd_validator* pgccd_validator_clone(const pgccd_validator* validator);
PGCCD_API void pgccd_validator_free(pgccd_validator* validator);

/* The number of values of a configuration, and of bodies, obstacles included. */
PGCCD_API int32_t pgccd_coordinate_count(const pgccd_validator* validator);
PGCCD_API int32_t pgccd_body_count(const pgccd_validator* validator);

/* The straight motion in joint space between two configurations. `budget`: body pairs to be tested over parts of it at
 * most; 0: any number. `motion` may be null: the search then ends with the first contact that it finds. */
PGCCD_API int32_t pgccd_check_motion(pgccd_validator* validator, const double* start, const double* goal,
                                     int64_t budget, pgccd_motion* motion);
/* Configurations (count, coordinates): valid[k] is 1 if no two bodies touch in the k-th. Returns 0, or PGCCD_BUSY. */
PGCCD_API int32_t pgccd_check_states(pgccd_validator* validator, const double* states, int64_t count, uint8_t* valid);

#ifdef __cplusplus
}
#endif
#endif
