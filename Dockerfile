# All commands on a CPU, but for depth networks and Ray. From the folder that holds the scene:
#   docker build -t splatseed SPLATSEED_FOLDER
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/work" splatseed upsample SCENE -o OUT
FROM python:3.11-slim

# OpenMP, for Numba's kernels.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libgomp1 \
    && rm -rf /var/lib/apt/lists/*

COPY pyproject.toml constraints.txt README.md LICENSE /source/
COPY src /source/src
# PyTorch's CPU build: its index stands in requirements.py.
RUN index=$(sed -n 's/^_CPU_BUILDS = "\(.*\)"/\1/p' /source/src/splatseed/requirements.py) \
    && pip install --no-cache-dir --constraint /source/constraints.txt --extra-index-url "$index" \
        "/source[train,view,sfm,scan,exr,r3d]" \
    && mkdir --mode 1777 /cache

# For any --user. Kernels are compiled at first use, into this home: mount a volume there to keep them.
ENV HOME=/cache USER=any
WORKDIR /work
ENTRYPOINT ["splatseed"]
CMD ["--help"]
