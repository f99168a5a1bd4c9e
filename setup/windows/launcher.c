// SPDX-License-Identifier: GPL-3.0-or-later
/* The python.exe of a virtual environment on Windows. It replaces CPython's venvlauncher.exe. It starts the python.exe in the
   folder that pyvenv.cfg names as `home`, with the same arguments, waits for it, and exits with its status. The variable
   __PYVENV_LAUNCHER__ gives that Python the path of this program. When this process is killed, that Python is killed too. */
#include <windows.h>
#include <stdio.h>
#include <wchar.h>

#define MAX_PATH_LENGTH 32768

static wchar_t self[MAX_PATH_LENGTH], folder[MAX_PATH_LENGTH], config[MAX_PATH_LENGTH], home[MAX_PATH_LENGTH], command[2 * MAX_PATH_LENGTH];

static FILE *open_config(const wchar_t *path) {
    _snwprintf(config, MAX_PATH_LENGTH, L"%ls\\pyvenv.cfg", path);
    return _wfopen(config, L"rb");
}

int wmain(void) {
    GetModuleFileNameW(NULL, self, MAX_PATH_LENGTH);
    wcscpy(folder, self);
    *wcsrchr(folder, L'\\') = 0;
    FILE *file = open_config(folder);
    if (!file) { /* this program is in Scripts, and pyvenv.cfg in the folder above */
        *wcsrchr(folder, L'\\') = 0;
        file = open_config(folder);
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
            MultiByteToWideChar(CP_UTF8, 0, value, -1, home, MAX_PATH_LENGTH);
        }
    }
    fclose(file);

    wchar_t *arguments = GetCommandLineW(); /* the command line without the program's own name */
    if (*arguments == L'"') {
        for (arguments++; *arguments && *arguments != L'"'; arguments++) {}
        if (*arguments) arguments++;
    } else {
        while (*arguments && *arguments != L' ') arguments++;
    }
    _snwprintf(command, 2 * MAX_PATH_LENGTH, L"\"%ls\\python.exe\"%ls", home, arguments);
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
