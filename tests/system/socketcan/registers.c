/* Preloaded into User-Mode Linux on a CPU with AMX. Linux takes a thread's extended registers back only whole; the kernel
 * inside keeps a buffer that ends before the tiles of AMX. What it hands back is filled up with registers in their first
 * state: nothing inside uses tiles. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

enum { HEADER = 512, ROOM = 1 << 16 }; /* the legacy area, then the header: which parts are in use (Intel SDM 1, 13.4) */

long ptrace(enum __ptrace_request request, ...)
{
	static _Alignas(64) unsigned char whole[ROOM];
	static long (*next)(enum __ptrace_request, ...);
	va_list rest;
	va_start(rest, request);
	pid_t pid = va_arg(rest, pid_t);
	void *address = va_arg(rest, void *);
	struct iovec *given = va_arg(rest, void *);
	va_end(rest);
	if (!next)
		next = (long (*)(enum __ptrace_request, ...))dlsym(RTLD_NEXT, "ptrace");
	if (request != PTRACE_SETREGSET || (uintptr_t)address != NT_X86_XSTATE)
		return next(request, pid, address, given);

	struct iovec all = { whole, sizeof whole };
	long failed = next(PTRACE_GETREGSET, pid, address, &all);
	if (failed || given->iov_len >= all.iov_len)
		return next(request, pid, address, given);
	memcpy(whole, given->iov_base, given->iov_len);
	memset(whole + given->iov_len, 0, all.iov_len - given->iov_len);
	uint64_t used;
	memcpy(&used, whole + HEADER, sizeof used);
	used &= ~(3ull << 17); /* TILECFG and TILEDATA */
	memcpy(whole + HEADER, &used, sizeof used);
	return next(request, pid, address, &all);
}
