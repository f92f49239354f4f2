/* A gripper's C library, as vendors ship them: an opaque handle, status codes, results by pointers. */
#ifndef GRIPPER_H
#define GRIPPER_H
#include <stddef.h>
#include <stdint.h>

typedef struct gripper gripper_t;

typedef struct {
    double width_m;
    double speed_m_s;
    int moving;
} gripper_state_t;

gripper_t *gripper_open(const char *port);               /* NULL: cannot be opened */
void gripper_close(gripper_t *);
int gripper_move(gripper_t *, double width_m, double speed_m_s); /* returns when it is there; below 0: failed */
int gripper_stop(gripper_t *);                           /* from any thread */
int gripper_state(gripper_t *, gripper_state_t *state);
int gripper_forces(gripper_t *, double *newtons, size_t count);
int gripper_set_fingers(gripper_t *, const double *offsets_m, size_t count);
uint32_t gripper_version(void);
const char *gripper_text(int status);

#endif
