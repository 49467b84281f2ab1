/* A simulated Cortex-M board that answers states, and prints what that took: no operating system,
   output by semihosting. states.h is written by board.py. With -DWITHOUT nothing is asked, and
   what the student takes is the difference in size. */
#include <stdint.h>

#include "student.h"
#include "states.h"

#ifndef WITHOUT
#define ASK(x, u) student(x, u)
#else
#define ASK(x, u) ((u)[0] = (x)[0])
#endif

#define PAINT 0x5AA55AA5u
#define PAINTED 16384 /* words below the caller's own frame */
#define CALIBRATION 1000000u
#define SYSTICK ((volatile uint32_t *)0xE000E010)
#define CPACR (*(volatile uint32_t *)0xE000ED88)

extern uint32_t data_source[], data_start[], data_end[], bss_start[], bss_end[], stack_top[];
static float actions[STATES][STUDENT_ACTIONS];

static int host(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static void say(uint32_t number, char after)
{
    char text[10];
    int i;
    for (i = 0; i < 8; i++)
        text[i] = "0123456789abcdef"[number >> (28 - 4 * i) & 15];
    text[8] = after;
    text[9] = 0;
    host(0x04, text);
}

/* Ticks since the clock was set to zero; it counts down 24 bits. */
static uint32_t ticks(void)
{
    return 0xFFFFFF - SYSTICK[2];
}

static void start_clock(void)
{
    SYSTICK[0] = 0;
    SYSTICK[1] = 0xFFFFFF;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5; /* on, the processor's own clock, no interrupt */
}

/* Two instructions a turn: how many instructions are a tick. */
static uint32_t calibrated(void)
{
    uint32_t turns = CALIBRATION;
    start_clock();
    __asm__ volatile("1: subs %0, #1\n bne 1b" : "+r"(turns) : : "cc");
    return ticks();
}

static __attribute__((noinline)) uint32_t stack_of_one(void)
{
    uint32_t *here = __builtin_frame_address(0);
    volatile uint32_t *low = here - PAINTED;
    uint32_t i;
    for (i = 0; i < PAINTED - 64; i++)
        low[i] = PAINT;
    ASK(states[0], actions[0]);
    for (i = 0; i < PAINTED && low[i] == PAINT; i++)
        ;
    return 4 * (PAINTED - i);
}

int main(void)
{
    uint32_t i, j, last, now, taken = 0;
    say(CALIBRATION, ' ');
    say(calibrated(), ' ');
    start_clock();
    last = ticks();
    for (i = 0; i < STATES; i++) {
        ASK(states[i], actions[i]);
        now = ticks();
        taken += (now - last) & 0xFFFFFF; /* one answer takes less than a turn of the clock */
        last = now;
    }
    say(taken, ' ');
    say(stack_of_one(), '\n');
    for (i = 0; i < STATES; i++)
        for (j = 0; j < STUDENT_ACTIONS; j++) {
            union { float value; uint32_t bits; } number = {actions[i][j]};
            say(number.bits, j + 1 < STUDENT_ACTIONS ? ' ' : '\n');
        }
    host(0x18, (void *)0x20026);
    return 0;
}

void reset(void)
{
    uint32_t *from = data_source, *to;
    CPACR |= 0xFu << 20; /* the floating-point unit */
    __asm__ volatile("dsb\n isb");
    for (to = data_start; to < data_end;)
        *to++ = *from++;
    for (to = bss_start; to < bss_end;)
        *to++ = 0;
    main();
}

static void fault(void)
{
    host(0x18, (void *)0x20023);
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    stack_top, (void *)reset, (void *)fault, (void *)fault,
    (void *)fault, (void *)fault, (void *)fault, (void *)fault,
};
