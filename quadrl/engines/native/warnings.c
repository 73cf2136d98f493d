// MuJoCo's warnings: a bounded number of lines, on stderr or at the end of a file.
//
// MuJoCo itself writes every one of them to stderr and to MUJOCO_LOG.TXT in the working folder.
// This is C, not Python, since threads that do not hold Python's lock may warn, and an exception
// there (by Ctrl-C, for example) would end the process.
#include <pthread.h>
#include <stdio.h>
#include <string.h>

#include "export.h"

enum { MOST = 120 };  // characters of a warning that are written

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static char file[4096];                  // empty: stderr
static int file_left, stderr_left = 10;  // lines that may still be written

QUADRL_EXPORT void quadrl_warning(const char* text) {
  pthread_mutex_lock(&lock);
  int* left = *file ? &file_left : &stderr_left;
  FILE* out = *left < 1 ? 0 : *file ? fopen(file, "a") : stderr;
  if (out) {
    if (out == stderr) fputs("quadrl: warning: MuJoCo: ", out);
    if (*left == 1) text = "there were more warnings, which are not written down";
    const size_t line = strcspn(text, "\n");
    fprintf(out, "%.*s\n", (int)(line < MOST ? line : MOST), text);
    --*left;
    if (out != stderr) fclose(out);
  }
  pthread_mutex_unlock(&lock);
}

// Lets at most so many lines be appended to a file; NULL: to stderr again, as many as are left.
QUADRL_EXPORT void quadrl_write_warnings(const char* path, int lines) {
  pthread_mutex_lock(&lock);
  *file = 0;
  if (path && strlen(path) < sizeof file) strcpy(file, path);
  file_left = lines;
  pthread_mutex_unlock(&lock);
}
