/* Waits in a read for words of one letter, each of which writes pages; no other page of it changes meanwhile. */
#include "tracee.h"

#define WORD 63

int main(int count, char **arguments) {
    volatile unsigned char *pages = map_pages(64, PROT_READ | PROT_WRITE, 0);
    char done = 'x';
    (void)count;
    int words = open(arguments[2], O_RDWR), answers = open(arguments[3], O_WRONLY);
    if (words < 0 || answers < 0) cannot("open the words and the answers");
    ready();
    while (read(words, (void *)(pages + WORD * PAGE), 1) == 1) {
        unsigned char word = pages[WORD * PAGE];
        pages[WORD * PAGE] = 0;
        if (word == 'm') /* many, and one between them not */
            for (int index = 0; index < 40; index++)
                if (index != 5) pages[index * PAGE] = (unsigned char)(100 + index);
        if (word == 'b') pages[5 * PAGE] = 77; /* the one between them */
        if (word == 'l') pages[45 * PAGE] = 77; /* a later one */
        if (word == 'z') pages[5 * PAGE] = 0; /* the one between them, which only now exists */
        if (word == 'd') pages[20 * PAGE] = pages[19 * PAGE]; /* one as the one before it */
        if (word == 'u') pages[19 * PAGE] = pages[20 * PAGE]; /* one as the one behind it */
        if (write(answers, &done, 1) != 1) return 1;
    }
    return 1;
}
