#!/usr/bin/env bash
# Builds realo with `--features cuda` on a machine that has neither a GPU nor CUDA: fetches the toolkit as wheels, puts a libcuda
# without a driver behind it in the linker's place, builds, and runs tests of what was built on the CPU. CI does not: the kernels
# of candle take long to compile. What it builds is for checks, not for a GPU: kernels that nobody needs are slow.
#
# Usage: tools/check_cuda.sh [cargo arguments; default: build --release --features cuda -p realo]
# CUDA_COMPUTE_CAP is the GPU's generation that kernels are compiled for, 90 (H100) unless set.
set -euo pipefail
cd "$(dirname "$0")/.."

toolkit=$PWD/target/cuda/nvidia/cu13
if [ ! -x "$toolkit/bin/nvcc" ]; then
  python3 -m pip install --quiet --no-deps --target target/cuda \
    "nvidia-cuda-nvcc==13.0.*" "nvidia-cuda-crt==13.0.*" "nvidia-nvvm==13.0.*" "nvidia-cuda-cccl==13.0.*" \
    "nvidia-cuda-runtime==13.0.*" "nvidia-cuda-nvrtc==13.0.*" "nvidia-curand==10.*" "nvidia-cublas==13.*"
fi

# Wheels have no names without a version, and a toolkit's folder is called lib64.
ln -sfn lib "$toolkit/lib64"
for library in cudart cublas cublasLt curand nvrtc; do
  found=$(cd "$toolkit/lib" && ls lib$library.so.* | head -n 1)
  ln -sfn "$found" "$toolkit/lib/lib$library.so"
done

# Kernels of quantised language models, which nothing here calls, take most of an hour to optimise: they are left as they are.
compiler=$toolkit/bin/nvcc-check
cat > "$compiler" <<'EOF'
#!/usr/bin/env bash
arguments=("$@")
case "${!#}" in
  *mmq_gguf/* | *mmvq_gguf.cu | *moe/*) arguments=("${@/#-O3/-O0}" -Xcicc -O0 -Xptxas -O0) ;;
esac
exec "$(dirname "$0")/nvcc" "${arguments[@]}"
EOF
chmod +x "$compiler"

# The driver's library belongs to the driver. In its place: every function that the bindings declare, each failing with
# CUDA_ERROR_NO_DEVICE.
stubs=$toolkit/lib/stubs
mkdir -p "$stubs"
cargo fetch --quiet
bindings=$(cargo metadata --format-version 1 --all-features | python3 -c '
import json, pathlib, sys
packages = json.load(sys.stdin)["packages"]
cudarc = next(package for package in packages if package["name"] == "cudarc")
print(pathlib.Path(cudarc["manifest_path"]).parent / "src/driver/sys/mod.rs")')
grep -oE 'fn cu[A-Z][A-Za-z0-9_]*' "$bindings" | sort -u | sed 's/fn \(.*\)/int \1(void) { return 100; }/' > "$stubs/libcuda.c"
cc -shared -fPIC -Wl,-soname,libcuda.so.1 -o "$stubs/libcuda.so" "$stubs/libcuda.c"
ln -sfn libcuda.so "$stubs/libcuda.so.1"

export CUDA_HOME=$toolkit CUDA_PATH=$toolkit CUDA_ROOT=$toolkit CUDA_TOOLKIT_ROOT_DIR=$toolkit
export NVCC=$compiler PATH=$toolkit/bin:$PATH CUDA_COMPUTE_CAP=${CUDA_COMPUTE_CAP:-90}
# Found by the linker without flags of rustc's, so that a usual build before or after this one has the same dependencies.
export LIBRARY_PATH=$toolkit/lib:$stubs${LIBRARY_PATH:+:$LIBRARY_PATH}
export LD_LIBRARY_PATH=$toolkit/lib:$stubs${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}
if [ $# -gt 0 ]; then
  exec cargo "$@"
fi
cargo build --release --features cuda -p realo
cargo test --release --features cuda -p realo-nn-candle
