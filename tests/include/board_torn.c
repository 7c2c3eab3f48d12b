/* Puts or gets values of which every eight bytes say the same number, until it is killed, or as often as it is told.
 *
 *     board_torn write ITEM SIZE         puts 1, 2, 3 … for ever, from what is there on
 *     board_torn read ITEM SIZE COUNT    gets so often; prints how many were found, overtaken and torn
 *     board_torn both ITEM SIZE COUNT    puts and gets in turn whatever comes, and looks for the item again; prints the same */
#include "failover_board.h"

#include <inttypes.h>

static union {
    uint64_t words[65536 / 8];
    unsigned char bytes[65536];
} value;

static void fill(uint64_t number, size_t size)
{
    for (size_t index = 0; index < (size + 7) / 8; index++)
        value.words[index] = number;
}

static bool is_whole(size_t size)
{
    return memcmp(value.bytes, value.bytes + 8, size - 8) == 0;
}

int main(int count, char **arguments)
{
    fb_board *board = fb_open(NULL);
    const size_t size = count > 3 ? (size_t)atoi(arguments[3]) : 0;
    fb_item *item = board == NULL || count < 4 ? NULL : fb_find(board, arguments[2], size, 0);
    uint64_t found = 0, overtaken = 0, torn = 0, last = 0, number = 0, backwards = 0;
    if (item == NULL) {
        fprintf(stderr, "%s\n", fb_error());
        return 1;
    }
    printf("ready\n");
    fflush(stdout);
    if (strcmp(arguments[1], "write") == 0) {
        fb_reading reading;
        number = fb_get_reading(item, FB_OWN, &value, &reading) == 0 ? reading.number : 0;
        for (;;) {
            fill(++number, size);
            if (fb_put(item, &value) != 0) {
                fprintf(stderr, "%s\n", fb_error());
                return 1;
            }
        }
    }
    const bool is_both = strcmp(arguments[1], "both") == 0;
    for (uint64_t turn = strtoull(arguments[4], NULL, 10); turn > 0; turn--) {
        fb_reading reading;
        fb_item *again = is_both && turn % 8 == 0 ? fb_find(board, arguments[2], size, 0) : NULL;
        item = again == NULL ? item : again;
        if (is_both && fb_put(item, &value) == 0)
            number++;
        int outcome = fb_get_reading(item, FB_OWN, &value, &reading);
        turn += outcome == -ENODATA; /* its writer is about to start */
        overtaken += outcome == -EAGAIN;
        if (outcome != 0)
            continue;
        found++;
        torn += !is_whole(size);
        backwards += reading.number < last;
        last = reading.number;
    }
    printf("found %" PRIu64 " overtaken %" PRIu64 " torn %" PRIu64 " backwards %" PRIu64 "\n", found, overtaken, torn, backwards);
    fb_close(board);
    return 0;
}
