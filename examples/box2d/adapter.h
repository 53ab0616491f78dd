/* A step of Box2D v3 with its own contact solver or with one of lavender, judged alike.
 *
 * Judged are the impulses of a step's last substep, as Box2D keeps them (float32), on the relaxed problem of that substep.
 * Contacts only: no joints, no rolling resistance, no bounce; one thread.
 */
#ifndef ADAPTER_H
#define ADAPTER_H

#include "box2d/box2d.h"
#include "lavender.h"

struct counts {
  int solves, missed;        /* of ours; those that ended above their tolerance */
  double seconds, measuring; /* of the step; what judging took beside it */
};

double seconds(void);                             /* of a clock; the caller's */
void check(int32_t code, const char *what);       /* ends the program with an error of lavender in words */
void begin(int ours, int method, int iterations); /* before the first step of a world */
struct counts step(b2WorldId id, float dt, int substeps, lav_verdict *verdict);

#endif
