/* A component with a board: puts its count as the item "map" every 2 ms, and reads what it is asked.
 *
 *     board_component         where there is a file "ask", writes a file "answer": what it knows of the board
 *     board_component wait    waits for the item "order" of this robot all the time, instead of napping */
#include "failover_board.h"

#include <inttypes.h>

static void tell(fb_board *board, fb_item *map, int put, uint64_t count)
{
    static const char *const whose[] = {"own", "peer"};
    FILE *file = fopen("answer.new", "w");
    char robot[65] = "";
    if (file == NULL)
        _exit(3);
    int named = fb_robot(board, robot, sizeof robot);
    fprintf(file, "robot %s\nput %d\ncount %" PRIu64 "\n", named == 0 ? robot : "none", put, count);
    for (int index = 0; index < 2; index++) {
        uint64_t value = 0;
        fb_reading reading = {0, 0, 0, 0, false};
        int outcome = fb_get_reading(map, index == 0 ? FB_OWN : FB_ROBOT("robot9"), &value, &reading);
        fprintf(file, "%s %d\n%s_value %" PRIu64 "\n%s_age %" PRId64 "\n%s_number %" PRIu64 "\n", whose[index], outcome, whose[index], value,
                whose[index], reading.age_ns, whose[index], reading.number);
    }
    fclose(file);
    if (rename("answer.new", "answer") != 0)
        _exit(3);
}

int main(int arguments, char **words)
{
    const struct timespec nap = {0, 2000000};
    fb_board *board = fb_open(NULL);
    fb_item *map = board == NULL ? NULL : fb_find(board, "map", sizeof(uint64_t), 0);
    fb_item *order = board == NULL ? NULL : fb_find(board, "order", sizeof(uint64_t), 0);
    if (map == NULL || order == NULL) {
        printf("%s\n", fb_error());
        return 1;
    }
    printf("ready\n");
    fflush(stdout);
    for (uint64_t count = 1;; count++) {
        int put = fb_put(map, &count);
        if (access("ask", F_OK) == 0 && unlink("ask") == 0)
            tell(board, map, put, count);
        if (arguments > 1 && strcmp(words[1], "wait") == 0) {
            fb_wait(order, FB_OWN, 0, NULL);
            uint64_t value = 0;
            if (fb_get(order, FB_OWN, &value, NULL) >= 0)
                printf("order %" PRIu64 "\n", value), fflush(stdout), words[1][0] = 'W';
        }
        nanosleep(&nap, NULL);
    }
}
