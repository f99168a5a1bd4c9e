// SPDX-License-Identifier: GPL-3.0-or-later
/* The python.exe of a virtual environment on Windows: starts the python.exe in the folder that pyvenv.cfg names as `home`,
   with the same arguments, tells it by __PYVENV_LAUNCHER__ who was called, waits, and passes its exit status on. As with
   CPython's own venvlauncher.exe, which it stands for, that Python ends when this process is ended. */
#include <windows.h>
#include <stdio.h>
#include <wchar.h>

#define LONGEST 32768

static wchar_t self[LONGEST], folder[LONGEST], config[LONGEST], home[LONGEST], command[2 * LONGEST];

static FILE *config_in(const wchar_t *path) {
    _snwprintf(config, LONGEST, L"%ls\\pyvenv.cfg", path);
    return _wfopen(config, L"rb");
}

int wmain(void) {
    GetModuleFileNameW(NULL, self, LONGEST);
    wcscpy(folder, self);
    *wcsrchr(folder, L'\\') = 0;
    FILE *file = config_in(folder);
    if (!file) { /* in Scripts, and pyvenv.cfg above it */
        *wcsrchr(folder, L'\\') = 0;
        file = config_in(folder);
    }
    if (!file) {
        fwprintf(stderr, L"failed to locate pyvenv.cfg\n");
        return 106;
    }
    char line[8192];
    while (fgets(line, sizeof line, file)) {
        char *value = strchr(line, '=');
        if (value && !strncmp(line, "home", 4)) {
            for (value++; *value == ' '; value++) {}
            value[strcspn(value, "\r\n")] = 0;
            MultiByteToWideChar(CP_UTF8, 0, value, -1, home, LONGEST);
        }
    }
    fclose(file);

    wchar_t *arguments = GetCommandLineW(); /* all of it, but for what was called */
    if (*arguments == L'"') {
        for (arguments++; *arguments && *arguments != L'"'; arguments++) {}
        if (*arguments) arguments++;
    } else {
        while (*arguments && *arguments != L' ') arguments++;
    }
    _snwprintf(command, 2 * LONGEST, L"\"%ls\\python.exe\"%ls", home, arguments);
    SetEnvironmentVariableW(L"__PYVENV_LAUNCHER__", self);

    HANDLE job = CreateJobObject(NULL, NULL);
    JOBOBJECT_EXTENDED_LIMIT_INFORMATION limits;
    DWORD status;
    QueryInformationJobObject(job, JobObjectExtendedLimitInformation, &limits, sizeof limits, &status);
    limits.BasicLimitInformation.LimitFlags |= JOB_OBJECT_LIMIT_KILL_ON_JOB_CLOSE | JOB_OBJECT_LIMIT_SILENT_BREAKAWAY_OK;
    SetInformationJobObject(job, JobObjectExtendedLimitInformation, &limits, sizeof limits);

    STARTUPINFOW startup;
    PROCESS_INFORMATION process;
    GetStartupInfoW(&startup);
    if (!CreateProcessW(NULL, command, NULL, NULL, TRUE, 0, NULL, NULL, &startup, &process)) {
        fwprintf(stderr, L"Unable to create process using '%ls'\n", command);
        return 101;
    }
    AssignProcessToJobObject(job, process.hProcess);
    WaitForSingleObjectEx(process.hProcess, INFINITE, FALSE);
    GetExitCodeProcess(process.hProcess, &status);
    return status;
}
