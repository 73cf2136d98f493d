// Runs a program on an STM32F405 without an operating system, which QEMU emulates: what main returns
// is what QEMU exits with.
#include <stdint.h>

extern uint32_t data_from, data_start, data_end, bss_start, bss_end, stack_top;
int main(void);

void reset(void) {
  *(volatile uint32_t*)0xE000ED88 |= 0xFu << 20;  // the floating-point unit
  for (uint32_t *to = &data_start, *from = &data_from; to < &data_end;) *to++ = *from++;
  for (uint32_t* to = &bss_start; to < &bss_end;) *to++ = 0;
  const uint32_t ended[2] = {0x20026, (uint32_t)main()};  // ADP_Stopped_ApplicationExit
  register uint32_t operation __asm__("r0") = 0x20;       // SYS_EXIT_EXTENDED
  register const uint32_t* given __asm__("r1") = ended;
  __asm__ volatile("bkpt 0xab" : : "r"(operation), "r"(given) : "memory");
  for (;;) {
  }
}

static void failed(void) {
  for (;;) {
  }
}

__attribute__((section(".vectors"), used)) static void* const vectors[16] = {
    &stack_top, (void*)reset, (void*)failed, (void*)failed, (void*)failed, (void*)failed, (void*)failed};
