/* A simulated device behind the interface of gripper.h: it moves in steps of a millisecond until it is told to stop. */
#include "gripper.h"

#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define WIDEST_M 0.085
#define STEP_S 0.001
#define FINGERS 2

struct gripper {
    FILE *port;
    _Atomic double width_m;
    _Atomic double speed_m_s;
    atomic_int moving;
    atomic_int stopped;
    double offsets_m[FINGERS];
};

enum { OUT_OF_RANGE = -1, STOPPED = -2, BUSY = -3, WRONG_COUNT = -4 };

gripper_t *gripper_open(const char *port) {
    FILE *file = fopen(port, "w");
    gripper_t *made = file ? calloc(1, sizeof *made) : NULL;
    if (file && !made) fclose(file);
    if (!made) return NULL;
    made->port = file;
    made->width_m = WIDEST_M;
    return made;
}

void gripper_close(gripper_t *g) {
    const struct timespec step = {0, (long)(STEP_S * 1e9)};
    while (g->moving) {
        gripper_stop(g);
        nanosleep(&step, NULL);
    }
    fclose(g->port);
    free(g);
}

static void step(gripper_t *g, double width_m) {
    const struct timespec step = {0, (long)(STEP_S * 1e9)};
    g->width_m = width_m;
    fprintf(g->port, "%.6f\n", width_m);
    fflush(g->port);
    nanosleep(&step, NULL);
}

int gripper_move(gripper_t *g, double width_m, double speed_m_s) {
    if (!(width_m >= 0 && width_m <= WIDEST_M && speed_m_s > 0)) return OUT_OF_RANGE;
    int still = 0;
    if (!atomic_compare_exchange_strong(&g->moving, &still, 1)) return BUSY;
    g->stopped = 0;
    g->speed_m_s = speed_m_s;
    double by_m = speed_m_s * STEP_S;
    while (!g->stopped && g->width_m != width_m) {
        double left_m = width_m - g->width_m;
        step(g, left_m > by_m ? g->width_m + by_m : left_m < -by_m ? g->width_m - by_m : width_m);
    }
    int result = g->stopped ? STOPPED : 0;
    g->speed_m_s = 0;
    g->moving = 0;
    return result;
}

int gripper_stop(gripper_t *g) {
    g->stopped = 1;
    return 0;
}

int gripper_state(gripper_t *g, gripper_state_t *state) {
    *state = (gripper_state_t){g->width_m, g->speed_m_s, g->moving};
    return 0;
}

int gripper_forces(gripper_t *g, double *newtons, size_t count) {
    if (count != FINGERS) return WRONG_COUNT;
    for (size_t i = 0; i < count; i++) newtons[i] = 10 * g->offsets_m[i];
    return 0;
}

int gripper_set_fingers(gripper_t *g, const double *offsets_m, size_t count) {
    if (count != FINGERS) return WRONG_COUNT;
    for (size_t i = 0; i < count; i++) g->offsets_m[i] = offsets_m[i];
    return 0;
}

uint32_t gripper_version(void) { return 4000000000u; }

const char *gripper_text(int status) {
    switch (status) {
    case OUT_OF_RANGE: return "out of range";
    case STOPPED: return "stopped on the way";
    case BUSY: return "it moves already";
    case WRONG_COUNT: return "it has two fingers";
    default: return NULL;
    }
}
