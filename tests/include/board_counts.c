/* Puts 1, 2, 3 … into an item, a hundred times a second; a put that fails is written to standard error and tried again. */

#define _GNU_SOURCE
#include <stdio.h>
#include <time.h>

#include "failover_board.h"

int main(int count, char **words)
{
    const struct timespec pause = {0, 10000000};
    fb_board *board = NULL;
    fb_item *item = NULL;
    uint64_t number = 0;
    if (count != 2)
        return 2;
    for (;; nanosleep(&pause, NULL)) {
        if (board == NULL)
            board = fb_open(NULL);
        if (board != NULL && item == NULL)
            item = fb_find(board, words[1], sizeof number, 0);
        if (item == NULL)
            fprintf(stderr, "%s\n", fb_error());
        else if (number++, fb_put(item, &number) != 0)
            fprintf(stderr, "%llu: %s\n", (unsigned long long)number, fb_error());
    }
}
