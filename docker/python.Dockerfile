# SPDX-License-Identifier: Apache-2.0
# The command line without a ROS: recordings, scans, images and videos in files. In the source tree:
#   docker build --file docker/python.Dockerfile --tag flowing-puppet .
#   docker run --rm --volume "$PWD:/data" flowing-puppet replay in.mcap --out out.mcap
FROM python:3.12-slim-bookworm

ENV NUMBA_CACHE_DIR=/var/cache/numba
WORKDIR /source
COPY . .
# The replay of the repository's own recording compiles the kernels, and is the test of this image.
RUN pip install --no-cache-dir --constraint requirements/lock.txt '.[neural,video]' \
    && flowing-puppet networks --install \
    && flowing-puppet replay bags/golden --out /tmp/golden.mcap \
    && rm -rf /tmp/golden.mcap build \
    && chmod -R a+rwX /var/cache/numba

WORKDIR /data
ENTRYPOINT ["flowing-puppet"]
CMD ["--help"]
