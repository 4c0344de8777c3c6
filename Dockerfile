# retropole without an installation of Python: docker build -t retropole . ; then, in the folder of the recordings,
#     docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" retropole calibrate front.pcd rear.pcd
FROM python:3.12-slim AS wheel
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY src src
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.12-slim
RUN --mount=type=bind,from=wheel,source=/wheels,target=/wheels \
    pip install --no-cache-dir "$(echo /wheels/retropole-*.whl)[figures,las,yaml,urdf,ros,velodyne,world]"
# What matplotlib caches goes where any user may write.
ENV MPLCONFIGDIR=/tmp/matplotlib
RUN useradd --create-home --uid 1000 retropole
USER retropole
WORKDIR /data
ENTRYPOINT ["retropole"]
CMD ["--help"]
