/* As much of Arduino's core as the sketch uses, for a PC; host.c carries it out. */
#ifndef ARDUINO_H
#define ARDUINO_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { LOW, HIGH };
enum { INPUT, OUTPUT };

void pinMode(uint8_t pin, uint8_t mode);
void digitalWrite(uint8_t pin, uint8_t level);
void analogWrite(uint8_t pin, int value);

/* Its members are called like those of Arduino's object. */
struct serial_port {
    void (*begin)(unsigned long baud);
    int (*available)(void);
    int (*read)(void);
    size_t (*write)(const char *text, size_t size);
};

extern const struct serial_port Serial;

#endif
