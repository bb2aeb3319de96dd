/* A disk that forgets, for one process and its children, by LD_PRELOAD.
 *
 * What lies below a root folder counts as being on the disk only once it was synced, as in the
 * harshest file system that POSIX allows:
 *
 * - the bytes of a file, by fsync() or fdatasync() of a descriptor, by msync(MS_SYNC) for the bytes
 *   of its range, or by a write through a descriptor with O_SYNC or O_DSYNC;
 * - the names in a folder (made, renamed, removed), by fsync() of that folder and nothing else.
 *
 * Each such call stores what it syncs in a shadow folder on the same file system, which
 * forgetting_disk.py makes and turns into the disk that is found after the power has come back:
 *
 *   data/INODE    the bytes of a file at its last sync
 *   names/INODE   the names in a folder at its last sync: type, inode and name, each ended by a NUL
 *   held/INODE    a link, so that the inode is not used again for another file
 *   failed/INODE  a file of which a sync failed: the kernel has dropped its pages, and later syncs
 *                 have nothing to write, though they succeed
 *
 * A folder's inode can't be held: nothing may make a folder after it removed one.
 *
 * Environment: FORGETTING_DISK_ROOT and FORGETTING_DISK_SHADOW, absolute; and for faults
 *
 *   FORGETTING_DISK_ENDS=N     the process is killed as it begins its Nth sync
 *   FORGETTING_DISK_FAILS=N    its Nth sync fails with EIO
 *   FORGETTING_DISK_NAME=TEXT  for both, only syncs of paths that end so are counted
 *   FORGETTING_DISK_ROOM=N     writes fail with ENOSPC after N bytes; reserved space can be used
 *
 * cc -shared -fPIC -O2 -o forgetting_disk.so forgetting_disk.c
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define PAGE 4096UL

static pthread_mutex_t disk = PTHREAD_MUTEX_INITIALIZER;
static long counted;       /* syncs so far */
static long long bytes_written;

/* A shadow that can't be written makes every result wrong. */
static void require(int holds, const char *what) {
  if (holds) return;
  dprintf(2, "forgetting disk: %s: %s\n", what, strerror(errno));
  abort();
}

static long long number_of(const char *name, long long otherwise) {
  const char *text = getenv(name);
  return text && *text ? atoll(text) : otherwise;
}

static int is_on_disk(const char *path) {
  const char *root = getenv("FORGETTING_DISK_ROOT");
  size_t length = root ? strlen(root) : 0;
  return length && !strncmp(path, root, length) && (path[length] == '/' || !path[length]);
}

/* Whether an open file is on the disk; its path also after it was removed. */
static int found_on_disk(int file, char path[PATH_MAX]) {
  char link[64];
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, PATH_MAX - 1);
  if (length < 0) return 0;
  path[length] = 0;
  return is_on_disk(path);
}

static void shadow_path(char out[PATH_MAX], const char *kind, unsigned long inode) {
  snprintf(out, PATH_MAX, "%s/%s/%lu", getenv("FORGETTING_DISK_SHADOW"), kind, inode);
}

static int open_draft(char draft[PATH_MAX], const char *path) {
  require(snprintf(draft, PATH_MAX, "%s.draft", path) < PATH_MAX, "path");
  int file = open(draft, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
  require(file >= 0, draft);
  return file;
}

static void hold(int folder, const char *name, int flags, unsigned long inode) {
  char held[PATH_MAX];
  shadow_path(held, "held", inode);
  linkat(folder, name, AT_FDCWD, held, flags); /* or it is there, or the file is gone by now */
}

/* Store the bytes of an open file. Renamed into place: a kill leaves the former ones. */
static void store_file(int file, const struct stat *facts) {
  char source[64], stored[PATH_MAX], draft[PATH_MAX];
  if (!facts->st_nlink) return; /* no name leads to it, and none that was synced ever did */
  snprintf(source, sizeof source, "/proc/self/fd/%d", file);
  hold(AT_FDCWD, source, AT_SYMLINK_FOLLOW, facts->st_ino);
  shadow_path(stored, "data", facts->st_ino);
  int from = open(source, O_RDONLY | O_CLOEXEC); /* the descriptor may be for writing only */
  require(from >= 0, source);
  int to = open_draft(draft, stored);
  ssize_t sent;
  while ((sent = sendfile(to, from, NULL, 1 << 20)) > 0) {
  }
  require(sent == 0, stored);
  close(from);
  close(to);
  require(!rename(draft, stored), stored);
}

static void store_folder(const char *path, const struct stat *facts) {
  char stored[PATH_MAX], draft[PATH_MAX];
  DIR *listing = opendir(path);
  if (!listing) return; /* it was removed */
  shadow_path(stored, "names", facts->st_ino);
  int to = open_draft(draft, stored);
  for (struct dirent *entry; (entry = readdir(listing));) {
    struct stat found;
    if (!strcmp(entry->d_name, ".") || !strcmp(entry->d_name, "..")) continue;
    if (fstatat(dirfd(listing), entry->d_name, &found, AT_SYMLINK_NOFOLLOW)) continue;
    if (S_ISREG(found.st_mode)) hold(dirfd(listing), entry->d_name, 0, found.st_ino);
    else if (!S_ISDIR(found.st_mode)) continue;
    char type = S_ISDIR(found.st_mode) ? 'd' : 'f';
    require(dprintf(to, "%c %lu %s%c", type, found.st_ino, entry->d_name, 0) > 0, stored);
  }
  closedir(listing);
  close(to);
  require(!rename(draft, stored), stored);
}

/* Count a sync and apply the faults; returns whether there is anything to store, -1 for an error. */
static int begin(const char *path, unsigned long inode) {
  char failed[PATH_MAX];
  const char *ending = getenv("FORGETTING_DISK_NAME");
  size_t length = strlen(path), wanted = ending ? strlen(ending) : 0;
  shadow_path(failed, "failed", inode);
  if (wanted <= length && !strcmp(path + length - wanted, ending ? ending : "")) {
    counted++;
    if (counted == number_of("FORGETTING_DISK_ENDS", 0)) kill(getpid(), SIGKILL);
    if (counted == number_of("FORGETTING_DISK_FAILS", 0)) {
      int mark = open(failed, O_WRONLY | O_CREAT | O_CLOEXEC, 0666);
      require(mark >= 0, failed);
      close(mark);
      errno = EIO;
      return -1;
    }
  }
  return access(failed, F_OK) != 0;
}

static int sync_file(int file, const char *path) {
  struct stat facts;
  if (fstat(file, &facts)) return -1;
  pthread_mutex_lock(&disk);
  int stores = begin(path, facts.st_ino);
  if (stores > 0 && S_ISREG(facts.st_mode)) store_file(file, &facts);
  if (stores > 0 && S_ISDIR(facts.st_mode)) store_folder(path, &facts);
  pthread_mutex_unlock(&disk);
  return stores < 0 ? -1 : 0;
}

int fsync(int file) {
  char path[PATH_MAX];
  return found_on_disk(file, path) ? sync_file(file, path) : REAL(fsync)(file);
}

int fdatasync(int file) {
  char path[PATH_MAX];
  return found_on_disk(file, path) ? sync_file(file, path) : REAL(fdatasync)(file);
}

/* Find the file on the disk that is mapped at an address, and the place of the address in it. */
static int mapped_file(const void *at, char path[PATH_MAX], unsigned long *inode, off_t *offset) {
  FILE *maps = fopen("/proc/self/maps", "re");
  char line[PATH_MAX + 128];
  int found = 0;
  require(maps != NULL, "/proc/self/maps");
  while (!found && fgets(line, sizeof line, maps)) {
    unsigned long start, stop, begins;
    int name = 0;
    line[strcspn(line, "\n")] = 0;
    if (sscanf(line, "%lx-%lx %*s %lx %*s %lu %n", &start, &stop, &begins, inode, &name) < 4) continue;
    if ((unsigned long)at < start || (unsigned long)at >= stop) continue;
    snprintf(path, PATH_MAX, "%s", line + name);
    *offset = begins + ((unsigned long)at - start);
    found = is_on_disk(path);
  }
  fclose(maps);
  return found;
}

static void store_range(const char *memory, size_t length, unsigned long inode, off_t offset) {
  char stored[PATH_MAX];
  shadow_path(stored, "data", inode);
  int to = open(stored, O_WRONLY | O_CREAT | O_CLOEXEC, 0666);
  require(to >= 0, stored);
  for (size_t at = 0; at < length;) {
    ssize_t done = REAL(pwrite)(to, memory + at, length - at, offset + at);
    require(done > 0, stored);
    at += done;
  }
  close(to);
}

int msync(void *start, size_t length, int flags) {
  char path[PATH_MAX];
  unsigned long inode;
  off_t offset;
  if (!(flags & MS_SYNC) || !mapped_file(start, path, &inode, &offset))
    return REAL(msync)(start, length, flags);
  pthread_mutex_lock(&disk);
  int stores = begin(path, inode);
  if (stores > 0) {
    hold(AT_FDCWD, path, 0, inode);
    store_range(start, (length + PAGE - 1) & -PAGE, inode, offset);
  }
  pthread_mutex_unlock(&disk);
  return stores < 0 ? -1 : 0;
}

/* How many of some bytes there is room for; -1 with an error for none. */
static ssize_t room_for(int file, size_t count) {
  char path[PATH_MAX];
  long long room = number_of("FORGETTING_DISK_ROOM", -1);
  if (room < 0 || !count || !found_on_disk(file, path)) return count;
  pthread_mutex_lock(&disk);
  long long left = room - bytes_written;
  ssize_t fit = left < (long long)count ? left : (ssize_t)count;
  bytes_written += fit;
  pthread_mutex_unlock(&disk);
  if (fit) return fit;
  errno = ENOSPC;
  return -1;
}

/* Sync after a write through a descriptor that asks for it. */
static ssize_t written(int file, ssize_t done) {
  char path[PATH_MAX];
  int flags = done > 0 ? fcntl(file, F_GETFL) : 0;
  if (flags > 0 && flags & O_DSYNC && found_on_disk(file, path) && sync_file(file, path)) return -1;
  return done;
}

ssize_t write(int file, const void *data, size_t count) {
  ssize_t fit = room_for(file, count);
  return fit < 0 ? -1 : written(file, REAL(write)(file, data, fit));
}

ssize_t pwrite(int file, const void *data, size_t count, off_t offset) {
  ssize_t fit = room_for(file, count);
  return fit < 0 ? -1 : written(file, REAL(pwrite)(file, data, fit, offset));
}

ssize_t pwrite64(int file, const void *data, size_t count, off64_t offset) {
  ssize_t fit = room_for(file, count);
  return fit < 0 ? -1 : written(file, REAL(pwrite64)(file, data, fit, offset));
}

ssize_t writev(int file, const struct iovec *parts, int count) {
  size_t total = 0;
  for (int k = 0; k < count; k++) total += parts[k].iov_len;
  ssize_t fit = room_for(file, total);
  if (fit < 0) return -1;
  if ((size_t)fit == total) return written(file, REAL(writev)(file, parts, count));
  size_t first = parts[0].iov_len < (size_t)fit ? parts[0].iov_len : (size_t)fit;
  return written(file, REAL(write)(file, parts[0].iov_base, first)); /* a short write is allowed */
}
