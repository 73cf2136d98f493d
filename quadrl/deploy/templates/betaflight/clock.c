// The clock of Betaflight's simulation target, loaded before the C library: time goes on by what the
// states that it receives say, and stands when they are used up. So a flight takes as long as the
// processor needs, and two flights are alike however busy the machine is.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdint.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum { STATE = 144, LOOK = 1000 };  // bytes of a state; nanoseconds that a look at the clock takes
static const int64_t SECOND = 1000000000;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed = PTHREAD_COND_INITIALIZER;
static int64_t now, until;      // [ns], of the main loop, and where it has to wait for a state
static int driven;              // a state has come: before, this is the machine's clock
static __thread int receives;   // this thread receives them
static __thread int64_t ahead;  // [ns], from the state before to the one that it works on
static __thread double last;    // [s], of that one

#define REAL(name) (real ? real : (real = (__typeof__(real))dlsym(RTLD_NEXT, #name)))

static int is_main(void) { return syscall(SYS_gettid) == getpid(); }

// The main loop goes on to a time, as far as states allow; the lock is held.
static void go(int64_t wanted) {
  while (now < wanted) {
    while (now >= until) pthread_cond_wait(&changed, &lock);
    now = wanted < until ? wanted : until;
    if (now >= until) pthread_cond_broadcast(&changed);
  }
}

int clock_gettime(clockid_t id, struct timespec* found) {
  static int (*real)(clockid_t, struct timespec*);
  if (id != CLOCK_MONOTONIC) return REAL(clock_gettime)(id, found);
  pthread_mutex_lock(&lock);
  if (driven) {
    if (is_main()) go(now + LOOK);
    found->tv_sec = now / SECOND;
    found->tv_nsec = now % SECOND;
  } else {
    REAL(clock_gettime)(id, found);
    now = until = found->tv_sec * SECOND + found->tv_nsec;
  }
  pthread_mutex_unlock(&lock);
  return 0;
}

int nanosleep(const struct timespec* asked, struct timespec* left) {
  static int (*real)(const struct timespec*, struct timespec*);
  if (!driven || !is_main()) return REAL(nanosleep)(asked, left);
  pthread_mutex_lock(&lock);
  go(now + asked->tv_sec * SECOND + asked->tv_nsec);
  pthread_mutex_unlock(&lock);
  return 0;
}

// Before the next state, the main loop uses up the time to the last one.
int select(int n, fd_set* read, fd_set* write, fd_set* except, struct timeval* most) {
  static int (*real)(int, fd_set*, fd_set*, fd_set*, struct timeval*);
  if (receives) {
    pthread_mutex_lock(&lock);
    until += ahead;
    ahead = 0;
    pthread_cond_broadcast(&changed);
    while (now < until) pthread_cond_wait(&changed, &lock);
    pthread_mutex_unlock(&lock);
  }
  return REAL(select)(n, read, write, except, most);
}

ssize_t recvfrom(int from, void* to, size_t size, int flags, struct sockaddr* who, socklen_t* length) {
  static ssize_t (*real)(int, void*, size_t, int, struct sockaddr*, socklen_t*);
  ssize_t found = REAL(recvfrom)(from, to, size, flags, who, length);
  if (size == STATE && found == STATE) {
    double at;
    memcpy(&at, to, sizeof at);
    if (receives) ahead += (int64_t)((at - last) * 1e9 + 0.5);
    last = at;
    receives = driven = 1;
  }
  return found;
}
