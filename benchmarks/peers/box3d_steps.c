/* Steps of a scene of boxes in Box3D, driven by its standard input, for `python -m benchmarks peers --box3d CHECKOUT`.

   The first line has dt [s], substeps, friction and the number of boxes of 1 kg/m^3; then a line for each box has its centre
   [m] and half extents [m]. The ground is below z = 0. A line with a number then does so many steps, and prints their CPU time
   [s] and the centres of all boxes [m]. Sleep and continuous collision are off, because nothing else here has them; one thread. */
#include "box3d/box3d.h"

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static double cpu_time(void)
{
    struct timespec now;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

int main(void)
{
    double dt, friction;
    int substeps, n, steps;
    if (scanf("%lf %d %lf %d", &dt, &substeps, &friction, &n) != 4 || n < 1) {
        return 1;
    }
    b3WorldDef world_def = b3DefaultWorldDef();
    world_def.gravity = (b3Vec3){0.0f, 0.0f, -9.81f};
    world_def.enableSleep = false;
    world_def.enableContinuous = false;
    world_def.workerCount = 1;
    b3WorldId world = b3CreateWorld(&world_def);

    b3ShapeDef shape_def = b3DefaultShapeDef();
    shape_def.baseMaterial.friction = (float)friction;
    b3BodyDef body_def = b3DefaultBodyDef();
    body_def.position = (b3Pos){0.0f, 0.0f, -1.0f};
    b3BoxHull ground = b3MakeBoxHull(400.0f, 400.0f, 1.0f);
    b3CreateHullShape(b3CreateBody(world, &body_def), &shape_def, &ground.base);

    b3BodyId *boxes = malloc(n * sizeof(b3BodyId));
    body_def.type = b3_dynamicBody;
    shape_def.density = 1.0f;
    for (int i = 0; i < n; i++) {
        double x[3], half[3];
        if (scanf("%lf %lf %lf %lf %lf %lf", x, x + 1, x + 2, half, half + 1, half + 2) != 6) {
            return 1;
        }
        body_def.position = (b3Pos){x[0], x[1], x[2]};
        b3BoxHull box = b3MakeBoxHull((float)half[0], (float)half[1], (float)half[2]);
        boxes[i] = b3CreateBody(world, &body_def);
        b3CreateHullShape(boxes[i], &shape_def, &box.base);
    }
    while (scanf("%d", &steps) == 1) {
        double start = cpu_time();
        for (int k = 0; k < steps; k++) {
            b3World_Step(world, (float)dt, substeps);
        }
        printf("%.9e", cpu_time() - start);
        for (int i = 0; i < n; i++) {
            b3Pos x = b3Body_GetPosition(boxes[i]);
            printf(" %.9e %.9e %.9e", (double)x.x, (double)x.y, (double)x.z);
        }
        printf("\n");
        fflush(stdout);
    }
    return 0;
}
