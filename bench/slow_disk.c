/* A slow disk for one process, by LD_PRELOAD: 10 MB/s, 50 ms a flush, one request at a time.
 *
 * write(), pwrite() and writev() to regular files take as long as such a disk needs for the bytes;
 * fsync(), fdatasync() and msync(MS_SYNC) take 50 ms more, msync() also the time of its bytes.
 * A real kernel keeps written bytes in memory and returns at once, so this is the harder case.
 *
 * cc -shared -fPIC -O2 -o slow_disk.so slow_disk.c
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <pthread.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <time.h>
#include <unistd.h>

#define NS_A_BYTE 100L       /* 10 MB/s */
#define NS_A_FLUSH 50000000L /* 50 ms */

static pthread_mutex_t disk = PTHREAD_MUTEX_INITIALIZER;

static void take(long ns) {
  int error = errno;
  struct timespec left = {ns / 1000000000L, ns % 1000000000L};
  pthread_mutex_lock(&disk);
  while (nanosleep(&left, &left) && errno == EINTR) {
  }
  pthread_mutex_unlock(&disk);
  errno = error;
}

static void take_bytes(int file, ssize_t count) {
  struct stat found;
  int error = errno;
  if (count > 0 && fstat(file, &found) == 0 && S_ISREG(found.st_mode)) take(count * NS_A_BYTE);
  errno = error;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int file, const void *data, size_t count) {
  ssize_t done = REAL(write)(file, data, count);
  take_bytes(file, done);
  return done;
}

ssize_t pwrite(int file, const void *data, size_t count, off_t offset) {
  ssize_t done = REAL(pwrite)(file, data, count, offset);
  take_bytes(file, done);
  return done;
}

ssize_t pwrite64(int file, const void *data, size_t count, off64_t offset) {
  ssize_t done = REAL(pwrite64)(file, data, count, offset);
  take_bytes(file, done);
  return done;
}

ssize_t writev(int file, const struct iovec *parts, int count) {
  ssize_t done = REAL(writev)(file, parts, count);
  take_bytes(file, done);
  return done;
}

int fsync(int file) {
  int code = REAL(fsync)(file);
  take(NS_A_FLUSH);
  return code;
}

int fdatasync(int file) {
  int code = REAL(fdatasync)(file);
  take(NS_A_FLUSH);
  return code;
}

int msync(void *start, size_t length, int flags) {
  int code = REAL(msync)(start, length, flags);
  if (flags & MS_SYNC) take(NS_A_FLUSH + (long)length * NS_A_BYTE);
  return code;
}
