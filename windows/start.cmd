@echo off
rem Starts splatfix on Windows and opens it in the browser. Double-click: the demo scene. A scene folder or file that is
rem dropped on this file is served instead. The first start installs everything below this folder, but for Python, which
rem uv keeps under %LOCALAPPDATA%: some gigabytes, mostly PyTorch. To uninstall, delete this folder.
setlocal
cd /d "%~dp0"
set "UV=uv.exe"
where uv.exe >nul 2>nul && goto environment
set "UV=%~dp0uv\uv.exe"
if exist "%UV%" goto environment
echo Installing uv, which installs Python and splatfix...
set "UV_INSTALL_DIR=%~dp0uv"
set "UV_NO_MODIFY_PATH=1"
powershell -NoProfile -ExecutionPolicy Bypass -Command "irm https://astral.sh/uv/install.ps1 | iex" || goto failed

:environment
if exist "environment\ready" goto start
for %%W in (splatfix-*.whl) do set "WHEEL=%%W"
if not defined WHEEL (
  echo The wheel of splatfix is missing: unpack the whole ZIP, then start this file from the unpacked folder.
  goto failed
)
"%UV%" venv --clear --python 3.12 environment || goto failed
"%UV%" pip install --python environment\Scripts\python.exe --constraint constraints.txt "%WHEEL%" || goto failed
echo ready>environment\ready

:start
if "%~1"=="" (
  environment\Scripts\splatfix.exe demo --browser || goto failed
) else (
  environment\Scripts\splatfix.exe serve "%~1" --browser || goto failed
)
exit /b 0

:failed
echo.
echo splatfix could not start; the lines above say why.
pause
exit /b 1
