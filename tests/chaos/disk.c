/* A disk that fails or a process that dies at the n-th thing it changes below a folder.

   Loaded before the C library (LD_PRELOAD), so that whatever Python, HDF5 or numpy does on the disk
   comes past. What is counted lies in memory that a process shares with its children. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

enum { ONLY_COUNT, FAIL_ONCE, FAIL_FOR_GOOD, KILL, TEAR_AND_KILL };

static struct {
    long count, at;
    int armed, mode, error, log;
    char root[PATH_MAX];
} *shared;

__attribute__((constructor)) static void begin(void) {
    shared = mmap(NULL, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (shared == MAP_FAILED)
        abort();
    memset(shared, 0, sizeof *shared);
}

#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* From now on, below `root`; `log` is an open file for a line each, or -1. */
void disk_arm(const char *root, long at, int mode, int error, int log) {
    strncpy(shared->root, root, sizeof shared->root - 1);
    shared->count = 0;
    shared->at = at;
    shared->mode = mode;
    shared->error = error;
    shared->log = log;
    shared->armed = 1;
}

void disk_disarm(void) { shared->armed = 0; }
long disk_count(void) { return shared->count; }

static void path_of(int handle, char *path) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", handle);
    ssize_t length = readlink(link, path, PATH_MAX - 1);
    path[length > 0 ? length : 0] = 0;
}

static void path_at(int folder, const char *name, char *path) {
    if (name[0] == '/' || folder == AT_FDCWD) {
        snprintf(path, PATH_MAX, "%s", name);
        return;
    }
    path_of(folder, path);
    size_t length = strlen(path);
    snprintf(path + length, PATH_MAX - length, "/%s", name);
}

/* Whether this one fails, with errno set; `handle` and `size` where it writes. */
static int strikes(const char *what, const char *path, int handle, const void *data, size_t size) {
    int kept = errno;
    if (!shared->armed || strncmp(path, shared->root, strlen(shared->root)) != 0)
        return 0;
    long number = ++shared->count;
    if (shared->log >= 0) {
        char line[PATH_MAX + 64];
        int length = snprintf(line, sizeof line, "%s\t%s\n", what, path);
        if (NEXT(write)(shared->log, line, length) < 0)
            abort();
    }
    errno = kept;
    if (shared->mode == ONLY_COUNT || number < shared->at)
        return 0;
    if (shared->mode >= KILL && number == shared->at) {
        if (shared->mode == TEAR_AND_KILL && data != NULL && NEXT(write)(handle, data, size / 2) < 0)
            abort();
        kill(getpid(), SIGKILL);
        pause();
    }
    if (shared->mode == FAIL_ONCE && number != shared->at)
        return 0;
    errno = shared->error;
    return 1;
}

ssize_t write(int handle, const void *data, size_t size) {
    char path[PATH_MAX];
    if (shared->armed) {
        path_of(handle, path);
        if (strikes("write", path, handle, data, size))
            return -1;
    }
    return NEXT(write)(handle, data, size);
}

/* HDF5's own way; torn, it lands where the file stands, which is as wrong. */
#define PWRITE(name, offset)                                                        \
    ssize_t name(int handle, const void *data, size_t size, offset where) {         \
        char path[PATH_MAX];                                                        \
        if (shared->armed) {                                                        \
            path_of(handle, path);                                                  \
            if (strikes("write", path, handle, data, size))                         \
                return -1;                                                          \
        }                                                                           \
        return NEXT(name)(handle, data, size, where);                               \
    }
PWRITE(pwrite, off_t)
PWRITE(pwrite64, off64_t)

#define OF_HANDLE(name)                            \
    int name(int handle) {                         \
        char path[PATH_MAX];                       \
        if (shared->armed) {                       \
            path_of(handle, path);                 \
            if (strikes(#name, path, 0, NULL, 0))  \
                return -1;                         \
        }                                          \
        return NEXT(name)(handle);                 \
    }
OF_HANDLE(fsync)
OF_HANDLE(fdatasync)

#define TRUNCATE(name, offset)                            \
    int name(int handle, offset size) {                   \
        char path[PATH_MAX];                              \
        if (shared->armed) {                              \
            path_of(handle, path);                        \
            if (strikes("ftruncate", path, 0, NULL, 0))   \
                return -1;                                \
        }                                                 \
        return NEXT(name)(handle, size);                  \
    }
TRUNCATE(ftruncate, off_t)
TRUNCATE(ftruncate64, off64_t)

static int strikes_renaming(int from, const char *old, int to, const char *new) {
    char path[2 * PATH_MAX + 1], target[PATH_MAX];
    path_at(from, old, path);
    path_at(to, new, target);
    size_t length = strlen(path);
    snprintf(path + length, sizeof path - length, "\t%s", target);
    return strikes("rename", path, 0, NULL, 0);
}

int rename(const char *old, const char *new) {
    if (shared->armed && strikes_renaming(AT_FDCWD, old, AT_FDCWD, new))
        return -1;
    return NEXT(rename)(old, new);
}

int renameat(int from, const char *old, int to, const char *new) {
    if (shared->armed && strikes_renaming(from, old, to, new))
        return -1;
    return NEXT(renameat)(from, old, to, new);
}

static int strikes_at(const char *what, int folder, const char *name) {
    char path[PATH_MAX];
    if (!shared->armed)
        return 0;
    path_at(folder, name, path);
    return strikes(what, path, 0, NULL, 0);
}

int unlink(const char *name) {
    return strikes_at("unlink", AT_FDCWD, name) ? -1 : NEXT(unlink)(name);
}

int unlinkat(int folder, const char *name, int flags) {
    return strikes_at("unlink", folder, name) ? -1 : NEXT(unlinkat)(folder, name, flags);
}

int mkdir(const char *name, mode_t mode) {
    return strikes_at("mkdir", AT_FDCWD, name) ? -1 : NEXT(mkdir)(name, mode);
}

int mkdirat(int folder, const char *name, mode_t mode) {
    return strikes_at("mkdir", folder, name) ? -1 : NEXT(mkdirat)(folder, name, mode);
}

#define OPEN(name)                                                    \
    int name(const char *path, int flags, ...) {                      \
        va_list more;                                                 \
        va_start(more, flags);                                        \
        mode_t mode = flags & O_CREAT ? va_arg(more, mode_t) : 0;     \
        va_end(more);                                                 \
        if (flags & O_CREAT && strikes_at("create", AT_FDCWD, path))  \
            return -1;                                                \
        return NEXT(name)(path, flags, mode);                         \
    }
OPEN(open)
OPEN(open64)

#define OPENAT(name)                                                \
    int name(int folder, const char *path, int flags, ...) {        \
        va_list more;                                               \
        va_start(more, flags);                                      \
        mode_t mode = flags & O_CREAT ? va_arg(more, mode_t) : 0;   \
        va_end(more);                                               \
        if (flags & O_CREAT && strikes_at("create", folder, path))  \
            return -1;                                              \
        return NEXT(name)(folder, path, flags, mode);               \
    }
OPENAT(openat)
OPENAT(openat64)
