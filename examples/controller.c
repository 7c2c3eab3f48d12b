/* A temperature controller that outlives its computer: kill it, start it again, and it goes on in the middle of its ramp.
 *
 *     cc -O2 -I include -pthread examples/controller.c -o controller -lm
 *     ./controller                        a step every 100 ms, for ever; its state lies in controller.segment
 *     ./controller 0 1000                 1000 steps without pause
 *     failover run -- ./controller        on a robot with an agent: its neighbour goes on with it
 *
 * What survives is what the next step needs and cannot measure. One that begins with an empty integral lets its plant fall. */
#include "failover.h"

#include <math.h>

static const double step_s = 0.1;

/* What survives. Plain numbers: no pointers, nothing that means something else in another process. */
static struct controller {
    double setpoint, integral, last_error, filtered; /* K, K s, K, K/s */
    int64_t step;
} controller = {293.0, 0.0, 0.0, 0.0, 0};

/* The plant: a real one stands outside and keeps its temperature by itself; leave this out and measure. */
static struct plant {
    double temperature, heater; /* K */
} plant = {293.0, 293.0};

static void drive(double power)
{
    plant.heater += step_s * (30.0 * power - (plant.heater - plant.temperature)) / 2.0;
    plant.temperature += step_s * ((plant.heater - plant.temperature) / 8.0 - (plant.temperature - 293.0) / 40.0);
}

/* PID with a filtered derivative; the integral rests while the output is at its limit. Answers 0 to 1 of the full power. */
static double controlled(struct controller *state, double temperature)
{
    const double gain = 0.08, integral_s = 25.0, derivative_s = 3.0, filter_s = 1.0;
    const double goal = state->step / 1500 % 2 == 0 ? 350.0 : 320.0, most = 0.5 * step_s; /* up and down by 0.5 K/s */
    state->setpoint += fmax(-most, fmin(most, goal - state->setpoint));
    const double error = state->setpoint - temperature;
    state->filtered += step_s / filter_s * ((error - state->last_error) / step_s - state->filtered);
    state->last_error = error;
    const double wanted = gain * (error + state->integral / integral_s + derivative_s * state->filtered);
    const double power = fmax(0.0, fmin(1.0, wanted));
    if (power == wanted || (wanted > power) != (error > 0.0))
        state->integral += error * step_s;
    return power;
}

static void tell_resumed(const failover_resumption *resumed, void *state)
{
    fprintf(stderr, "going on at step %lld, %s, as of %.2f s ago\n%s", (long long)((struct controller *)state)->step, resumed->why,
            resumed->age_s, resumed->notes);
}

int main(int count, char **words)
{
    const long period_ms = count > 1 ? atol(words[1]) : 100, steps = count > 2 ? atol(words[2]) : -1;
    struct timespec next;
    failover_region(&controller, sizeof controller, "controller");
    failover_region(&plant, sizeof plant, "plant");
    failover_on_resume(tell_resumed, &controller);
    if (failover_open("controller") < 0) {
        fprintf(stderr, "%s\n", failover_error());
        return 1;
    }
    clock_gettime(CLOCK_MONOTONIC, &next);
    while (steps < 0 || controller.step < steps) {
        const double power = controlled(&controller, plant.temperature);
        drive(power);
        printf("%lld %.17g %.17g\n", (long long)++controller.step, plant.temperature, power);
        fflush(stdout);
        if (failover_commit() < 0) /* a consistent point: all regions belong to the same step */
            fprintf(stderr, "%s\n", failover_error());
        next.tv_nsec += period_ms % 1000 * 1000000;
        next.tv_sec += period_ms / 1000 + next.tv_nsec / 1000000000;
        next.tv_nsec %= 1000000000;
        while (period_ms > 0 && clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL) == EINTR)
            continue;
    }
    return failover_close() == 0 ? 0 : 1;
}
