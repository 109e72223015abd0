/* Makes the k-th call that writes into a folder fail, for whatever process this library is preloaded into.

       gcc -shared -fPIC -O1 -o failing_calls.so failing_calls.c -ldl

   Counted are the calls that make, fill, flush, name or cut a file below the folder: open for writing, mkdir, write,
   pwrite, writev, fsync, ftruncate, rename, link. Removing always works, as it does on a full disk, and so does renaming
   onto a name that is there, which needs no room, once an earlier call has found none. Calls are counted over all
   processes that have been forked since the library was loaded. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

#define MOST_FILES 4096

static char folder[PATH_MAX];
static size_t folder_length;
static long first_failing;           /* 0: none fails */
static int failing_errno, lasting, signal_sent;
static volatile long *calls;         /* shared by all forked processes */
static char ours[MOST_FILES];        /* whether a descriptor writes below the folder */

__attribute__((constructor)) static void load(void) {
    calls = mmap(NULL, sizeof *calls, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
}

/* From now on count calls below `path`; fail the `first` with `number` (and all that follow if `on`), or send `signal`. */
void failing_calls_arm(const char *path, long first, int number, int on, int signal) {
    strncpy(folder, path, sizeof folder - 1);
    folder_length = strlen(folder);
    first_failing = first, failing_errno = number, lasting = on, signal_sent = signal;
    *calls = 0;
}

long failing_calls_count(void) { return *calls; }

static int below(const char *path) {
    return folder_length && path && !strncmp(path, folder, folder_length);
}

static int writes(int fd) { return folder_length && fd >= 0 && fd < MOST_FILES && ours[fd]; }

/* Count a call, which may need room on the disk; return whether it is to fail. */
static int fails(int needs_room) {
    long number = __sync_add_and_fetch(calls, 1);
    int goes_on = lasting && !signal_sent && (needs_room || failing_errno != ENOSPC);
    if (!first_failing || number < first_failing || (number > first_failing && !goes_on)) return 0;
    if (signal_sent) {
        kill(getpid(), signal_sent);
        return 0;
    }
    errno = failing_errno;
    return 1;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define ONE(name, result, parameters, arguments, counted) \
    result name parameters {                              \
        if ((counted) && fails(1)) return -1;             \
        return REAL(name) arguments;                      \
    }

ONE(write, ssize_t, (int fd, const void *bytes, size_t n), (fd, bytes, n), writes(fd))
ONE(pwrite, ssize_t, (int fd, const void *bytes, size_t n, off_t at), (fd, bytes, n, at), writes(fd))
ONE(pwrite64, ssize_t, (int fd, const void *bytes, size_t n, off64_t at), (fd, bytes, n, at), writes(fd))
ONE(writev, ssize_t, (int fd, const struct iovec *parts, int n), (fd, parts, n), writes(fd))
ONE(fsync, int, (int fd), (fd), writes(fd))
ONE(fdatasync, int, (int fd), (fd), writes(fd))
ONE(ftruncate, int, (int fd, off_t size), (fd, size), writes(fd))
ONE(ftruncate64, int, (int fd, off64_t size), (fd, size), writes(fd))
ONE(mkdir, int, (const char *path, mode_t mode), (path, mode), below(path))
ONE(link, int, (const char *from, const char *to), (from, to), below(to))
ONE(linkat, int, (int a, const char *from, int b, const char *to, int flags), (a, from, b, to, flags), below(to))

int rename(const char *from, const char *to) {
    if (below(to) && fails(access(to, F_OK) != 0)) return -1;
    return REAL(rename)(from, to);
}

static int is_writing(const char *path, int flags) { return below(path) && (flags & (O_WRONLY | O_RDWR | O_CREAT)); }

static int note(int fd, int writing) {
    if (fd >= 0 && fd < MOST_FILES) ours[fd] = writing;
    return fd;
}

#define MODE(flags)                            \
    mode_t mode = 0;                           \
    if ((flags) & O_CREAT) {                   \
        va_list rest;                          \
        va_start(rest, flags);                 \
        mode = (mode_t)va_arg(rest, int);      \
        va_end(rest);                          \
    }
#define OPEN(name)                                                         \
    int name(const char *path, int flags, ...) {                           \
        MODE(flags)                                                        \
        int writing = is_writing(path, flags);                             \
        if (writing && fails(1)) return -1;                                \
        return note(REAL(name)(path, flags, mode), writing);               \
    }
#define OPENAT(name)                                                       \
    int name(int at, const char *path, int flags, ...) {                   \
        MODE(flags)                                                        \
        int writing = is_writing(path, flags);                             \
        if (writing && fails(1)) return -1;                                \
        return note(REAL(name)(at, path, flags, mode), writing);           \
    }

OPEN(open)
OPEN(open64)
OPENAT(openat)
OPENAT(openat64)

int close(int fd) {
    note(fd, 0);
    return REAL(close)(fd);
}
